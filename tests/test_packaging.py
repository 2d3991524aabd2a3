"""The package: licences of what it needs, its citation, its source distribution, machines without pycolmap."""

import itertools
import re
import runpy
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from survey.errors import SurveyError
from survey.folder.sfm_views import require_solver

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
LICENCES = runpy.run_path(str(ROOT / "scripts" / "licences.py"))
UV = runpy.run_path(str(ROOT / "scripts" / "uv_settings.py"))


def test_the_licence_of_everything_that_is_needed_fits():
    found = LICENCES["needed"]("bathynerf", tuple(PROJECT["optional-dependencies"]))
    assert {"numpy", "torch", "typer", "pyproj", "pytest"} <= found.keys()
    licences = {name: LICENCES["licence_of"](package) for name, package in found.items()}
    assert [name for name, licence in licences.items() if not LICENCES["fits"](name, licence)] == []


@pytest.mark.parametrize(
    ("licence", "is_fit"),
    [
        ("Apache-2.0", True),
        ("MIT", True),
        ("BSD-3-Clause AND MIT", True),
        ("MIT OR GPL-2.0-only", True),
        ("MPL-2.0", True),
        ("GPL-3.0-or-later", False),
        ("MIT AND GPL-2.0-only", False),
        ("GNU Lesser General Public License v3 (LGPLv3)", False),
        ("AGPL-3.0", False),
        ("CC-BY-NC-4.0", False),
        ("Free for non-commercial use", False),
        ("unknown", False),
    ],
)
def test_a_licence_fits_that_may_be_used_with_apache(licence, is_fit):
    assert LICENCES["fits"]("package", licence) == is_fit


def test_the_citation_is_of_this_version_and_licence():
    citation = (ROOT / "CITATION.cff").read_text()
    assert dict(re.findall(r"^(version|license): (.*)$", citation, re.MULTILINE)) == {
        "version": PROJECT["version"],
        "license": PROJECT["license"],
    }


# Names in conda-forge, where they differ.
IN_CONDA = {
    "torch": "pytorch", "opencv-python-headless": "py-opencv", "libigl": "igl", "matplotlib": "matplotlib-base",
}  # fmt: skip


def test_the_recipe_of_conda_needs_what_the_package_needs():
    recipe = (ROOT / "conda" / "recipe.yaml").read_text()
    wanted = [Requirement(text) for text in PROJECT["dependencies"]]
    expected = {IN_CONDA.get(each.name, each.name): set(str(each.specifier).split(",")) for each in wanted}
    _, _, run = recipe.partition("  run:\n")
    needs = dict(re.findall(r"^    - (\S+) ?(\S*)$", run.partition("\ntests:")[0], re.MULTILINE))
    # Of laspy's extra, and what Dr.Jit loads.
    assert needs.keys() - expected.keys() == {"python", "llvmdev", "lazrs-python"}
    assert {name: set(needs[name].split(",")) for name in expected} == expected
    assert set(needs["python"].split(",")) == set(PROJECT["requires-python"].split(","))
    assert re.search(r'version: "(.*)"', recipe)[1] == PROJECT["version"]
    ((name, target),) = PROJECT["scripts"].items()
    assert f"- {name} = {target}\n" in recipe


def test_what_the_source_distribution_names_is_there():
    lines = (ROOT / "MANIFEST.in").read_text().splitlines()
    named = [name for line in lines if line.split()[0] in ("include", "graft") for name in line.split()[1:]]
    assert {"docs", "constraints.txt", "Makefile"} <= set(named)
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize(
    ("system", "machine", "is_needed"),
    [("linux", "x86_64", True), ("linux", "aarch64", False), ("darwin", "arm64", True), ("win32", "AMD64", True)],
)
def test_pycolmap_is_needed_where_it_has_a_wheel(system, machine, is_needed):
    (text,) = [text for text in PROJECT["dependencies"] if text.startswith("pycolmap")]
    marker = Requirement(text).marker
    assert marker is not None
    assert marker.evaluate({"sys_platform": system, "platform_machine": machine}) == is_needed


def test_without_pycolmap_poses_are_asked_for():
    require_solver()
    with pytest.raises(SurveyError, match=r"pycolmap.* is not installed.*Name a file of poses"):
        require_solver("no_such_module")


def test_the_container_installs_extras_that_there_are_and_the_libraries_of_setup():
    recipe = (ROOT / "Containerfile").read_text()
    extras = re.search(r"bathynerf\[([a-z0-9,]+)\]", recipe).group(1).split(",")
    assert (
        set(extras) <= tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"].keys()
    )
    libraries = re.search(r"libllvm\d+", (ROOT / "scripts" / "setup.sh").read_text()).group()
    assert libraries in recipe


@pytest.mark.parametrize(
    ("listing", "expected"),
    [
        ("", {"UV_TORCH_BACKEND": "auto"}),
        (
            "global.extra-index-url='\\nhttps://a.example/simple\\nhttps://b.example/simple'\n:env:.cert='/c.pem'",
            {
                "UV_INDEX": "https://a.example/simple https://b.example/simple",
                "UV_INDEX_STRATEGY": "unsafe-best-match",
                "SSL_CERT_FILE": "/c.pem",
            },
        ),
        ("global.find-links='/a b'\ninstall.find-links='/c /d'", {"UV_FIND_LINKS": "/c,/d"}),
        (
            "install.timeout='20'\n:env:.timeout='60'\nglobal.no-index='true'",
            {"UV_HTTP_TIMEOUT": "60", "UV_NO_INDEX": "true"},
        ),
        ("freeze.timeout='20'\nglobal.progress-bar='off'", {"UV_TORCH_BACKEND": "auto"}),
    ],
)
def test_settings_of_pip_reach_uv_with_those_of_the_command_and_variables_before_global_ones(listing, expected):
    assert UV["uv_settings"](UV["pip_settings"](listing), system="linux") == expected


def test_off_linux_the_package_index_has_the_cpu_build_of_torch():
    assert UV["uv_settings"]({}, system="darwin") == {}


def test_every_requirement_has_a_tested_version_that_it_allows():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    locked = [Requirement(line) for line in lines if not line.startswith("#")]
    versions = {}
    for each in locked:
        ((operator, version),) = [(part.operator, part.version) for part in each.specifier]
        assert operator == "=="
        versions.setdefault(canonicalize_name(each.name), []).append(version)
    extras = PROJECT["optional-dependencies"].values()
    for text in [*PROJECT["dependencies"], *itertools.chain.from_iterable(extras)]:
        wanted = Requirement(text)
        if wanted.name != PROJECT["name"]:
            assert all(map(wanted.specifier.contains, versions[canonicalize_name(wanted.name)])), text
