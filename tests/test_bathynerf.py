"""The Python interface: what it exports, and packages of other projects that have the names of ours."""

import ast
import importlib
import importlib.metadata
import os
import subprocess
import sys
from pathlib import Path

import pytest

import bathynerf
from bathynerf._packages import PACKAGES

FILE = Path(bathynerf.__file__)


def for_editors() -> dict[str, tuple[str, str]]:
    """Module and name there of each name that editors and type checkers are told."""
    tree = ast.parse(FILE.with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in tree.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names}


def test_the_names_for_editors_are_the_public_names():
    (named,) = (
        node.value
        for node in ast.parse(FILE.with_suffix(".pyi").read_text(encoding="utf-8")).body
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
    )
    assert sorted(ast.literal_eval(named)) == bathynerf.__all__ == dir(bathynerf)


@pytest.mark.parametrize("name", sorted(for_editors()))
def test_a_name_is_the_thing_that_editors_are_told(name):
    module, there = for_editors()[name]
    assert getattr(bathynerf, name) is getattr(importlib.import_module(module), there)


def test_the_version_is_that_of_the_distribution():
    assert bathynerf.__version__ == importlib.metadata.version("bathynerf")


def test_a_name_that_does_not_exist_is_said_to_be_missing():
    with pytest.raises(AttributeError, match="'bathynerf' has no attribute 'proces'"):
        _ = bathynerf.proces
    with pytest.raises(ImportError, match="cannot import name 'proces'"):
        exec("from bathynerf import proces")


def test_the_import_alone_brings_neither_a_room_nor_a_library():
    code = "import sys, bathynerf; print(*{m.split('.')[0] for m in sys.modules})"
    loaded = set(
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    )
    assert "bathynerf" in loaded
    assert (
        loaded & {"torch", "numpy", "drjit", "cv2", "scipy", "survey", "fields", "refract", "geo", "evaluation"}
        == set()
    )


ROOT = Path(__file__).resolve().parent.parent


def package_of_others(folder: Path) -> None:
    folder.mkdir(parents=True)
    (folder / "__init__.py").write_text("from evaluation.tables import Table\n")


def run(*command: str, path: Path, cwd: Path) -> subprocess.CompletedProcess:
    environment = {**os.environ, "PYTHONPATH": str(path)}
    return subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False, cwd=cwd, env=environment
    )


@pytest.fixture
def installed(tmp_path) -> Path:
    """An installation in which another project's package lies in the place of one of ours, as pip leaves it."""
    root = tmp_path / "site-packages"
    root.mkdir()
    for package in {*PACKAGES, "bathynerf"} - {"evaluation"}:
        (root / package).symlink_to(ROOT / package)
    (root / "bathynerf").unlink()
    (root / "bathynerf").mkdir()
    for file in (ROOT / "bathynerf").glob("*.py*"):
        (root / "bathynerf" / file.name).write_text(file.read_text(encoding="utf-8"), encoding="utf-8")
    package_of_others(root / "evaluation")
    info = root / "evaluation-0.0.2.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: evaluation\nVersion: 0.0.2\n")
    (info / "RECORD").write_text("evaluation/__init__.py,,\n")
    return root


def test_a_package_of_others_earlier_on_the_path_is_passed_by(tmp_path):
    package_of_others(tmp_path / "evaluation")
    both = Path(f"{tmp_path}{os.pathsep}{ROOT}")
    shown = run("-m", "bathynerf", "--help", path=both, cwd=tmp_path)
    assert "compare" in shown.stdout, shown.stderr
    code = "import bathynerf, importlib.util; print(importlib.util.find_spec('evaluation').origin)"
    assert run("-c", code, path=both, cwd=tmp_path).stdout.strip() == str(ROOT / "evaluation" / "__init__.py")


def test_a_package_of_others_in_the_place_of_ours_is_named_with_its_place_and_what_to_do(installed, tmp_path):
    shown = run("-m", "bathynerf", "--help", path=installed, cwd=tmp_path)
    assert shown.returncode == 2
    assert "Traceback" not in shown.stderr
    assert f"error: evaluation 0.0.2 of another project lies in {installed / 'evaluation'}, where" in shown.stderr
    assert "an environment of its own" in shown.stderr
    shown = run("-c", "from bathynerf import process", path=installed, cwd=tmp_path)
    assert "ForeignPackage: evaluation 0.0.2 of another project lies in" in shown.stderr


def test_a_package_of_others_that_was_imported_before_is_named(tmp_path):
    package_of_others(tmp_path / "evaluation")
    (tmp_path / "evaluation" / "__init__.py").write_text("")
    code = "import evaluation; from bathynerf import process"
    shown = run("-c", code, path=Path(f"{tmp_path}{os.pathsep}{ROOT}"), cwd=tmp_path)
    assert f"the package evaluation of {tmp_path / 'evaluation'} was imported before bathynerf" in shown.stderr
