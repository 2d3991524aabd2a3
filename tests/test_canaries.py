"""Guards of the guards: what would fail silently if nobody looked."""

import importlib
import importlib.metadata
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("bathynerf", "refract", "fields", "survey", "geo", "evaluation")
# The suite has had more than this since its first release; fewer mean that a folder is no longer collected.
LEAST_TESTS = 600
# Homes and mounts of single machines, and hosts that serve packages; in pieces, so that this file does not hold them.
OF_ONE_MACHINE = re.compile(
    r"(?<![\w.$}-])/(?:" + "|".join(("root", "work", "mnt", "home/[a-z]", "Users/[a-z]", "workspace")) + r")/"
    r"|file:/" + r"//"
    r"|\b(?:" + "|".join((r"py" + r"pi", r"files\.python" + "hosted", r"download\.py" + "torch")) + r")\.org"
    r"|\blocal" + "host" + r"\b"
)
# Commands that serve a browser name the address of the machine that they run on.
LOOPBACK, SERVING = "local" + "host", ("docs/", "survey/", "tests/")


def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def project() -> dict:
    return tomllib.loads(text_of("pyproject.toml"))["project"]


def run_pytest(folder: Path, test: str, *options: str) -> subprocess.CompletedProcess:
    """Run one test file with the settings of this project; `test` is its text."""
    path = folder / "test_one.py"
    path.write_text(test, encoding="utf-8")
    settings = ("-c", ROOT / "pyproject.toml", "--rootdir", ROOT, "-p", "no:cacheprovider")
    command = [sys.executable, "-m", "pytest", *map(str, settings), *options, str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)


@pytest.mark.parametrize("marker", ["gpu", "slow"])
def test_tests_for_a_gpu_and_tests_of_minutes_are_not_in_the_default_run(marker, tmp_path):
    run = run_pytest(tmp_path, f"import pytest\n@pytest.mark.{marker}\ndef test_it():\n    raise OSError\n")
    assert "1 deselected" in run.stdout
    assert run.returncode == pytest.ExitCode.NO_TESTS_COLLECTED


def test_a_marker_that_is_not_declared_and_a_warning_are_errors(tmp_path):
    run = run_pytest(tmp_path, "import pytest\n@pytest.mark.gpuu\ndef test_it():\n    pass\n")
    assert "'gpuu' not found in `markers`" in run.stdout
    run = run_pytest(tmp_path, "import warnings\ndef test_it():\n    warnings.warn('mind this')\n")
    assert "1 failed" in run.stdout


def test_the_whole_suite_is_collected(request):
    config = request.config
    if config.args != config.getini("testpaths") or config.getoption("keyword") or config.getoption("lf", False):
        pytest.skip("only a part of the suite was asked for")
    assert request.session.testscollected >= LEAST_TESTS


def test_the_python_versions_of_pyproject_are_those_of_readme_and_setup():
    low, high = re.fullmatch(r">=3\.(\d+),<3\.(\d+)", project()["requires-python"]).groups()
    assert f"Python 3.{low} to 3.{int(high) - 1}" in text_of("README.md")
    assert f'target-version = "py3{low}"' in text_of("pyproject.toml")
    # setup.sh reads the line itself, in this form.
    assert f'\nrequires-python = ">=3.{low},<3.{high}"\n' in text_of("pyproject.toml")


def test_the_version_is_the_one_at_the_head_of_the_changelog():
    newest = re.search(r"^## \[?(\d+\.\d+\.\d+)", text_of("CHANGELOG.md"), re.MULTILINE)
    assert newest[1] == project()["version"]


def test_help_and_the_page_of_commands_list_the_same_verbs():
    code = "from survey.commands.app import main; main()"
    environment = {**os.environ, "COLUMNS": "200", "TERM": "dumb"}
    command = [sys.executable, "-c", code, "--help"]
    shown = subprocess.run(command, capture_output=True, text=True, check=True, env=environment, cwd=ROOT).stdout
    listed = shown.partition("Commands")[2].partition("Exit codes")[0]
    verbs = set(re.findall(r"^\W*([a-z]+) {2,}\S", listed, re.MULTILINE))
    assert {"check", "process", "compare"} < verbs
    assert set(re.findall(r"^ +bathynerf ([a-z]+) [A-Z]", text_of("docs/commands.md"), re.MULTILINE)) == verbs


def test_the_console_command_is_the_command_line():
    (command,) = importlib.metadata.entry_points(group="console_scripts", name="bathynerf")
    assert command.value == "bathynerf.__main__:main"


def test_make_knows_the_targets_that_readme_names():
    targets = set(re.findall(r"^([a-z]+):", text_of("Makefile"), re.MULTILINE))
    named = set(re.findall(r"\bmake ([a-z]+)", text_of("README.md")))
    assert {"demo", "test"} <= named <= targets
    assert "make test" in text_of(".ci/run")


def test_every_dependency_is_imported_somewhere():
    modules = {"opencv-python-headless": "cv2", "pillow": "PIL", "libigl": "igl", "tomli-w": "tomli_w"}
    code = "\n".join(path.read_text(encoding="utf-8") for path in python_files())
    for line in project()["dependencies"]:
        name = re.match(r"[\w-]+", line)[0]
        module = modules.get(name, name)
        assert re.search(rf"^\s*(import|from) {module}\b", code, re.MULTILINE), f"nothing imports {module} ({name})"


def python_files() -> list[Path]:
    return [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]


def documents() -> list[Path]:
    return [
        *(ROOT / name for name in ("README.md", "CONVENTIONS.md", "CONTRIBUTING.md")),
        *(ROOT / "docs").rglob("*.md"),
    ]


# Their names begin as those of packages do.
FILES_OF_USERS = {"survey.toml", "survey.schema.json", "geo.txt"}


@pytest.mark.parametrize("path", documents(), ids=lambda path: path.name)
def test_what_a_document_names_exists(path):
    text = path.read_text(encoding="utf-8")
    packages = "|".join(PACKAGES)
    for name in set(re.findall(rf"`((?:{packages})(?:\.\w+)+)`", text)) - FILES_OF_USERS:
        assert exists(name), f"{path.name} names {name}, which does not exist"
    for name in re.findall(rf"`((?:{packages}|benchmarks|tests|scripts|docs|examples)/[\w/]+\.\w+)`", text):
        assert (ROOT / name).exists(), f"{path.name} names {name}, which does not exist"
    for name in re.findall(r"\b(benchmarks/\w+\.py)", text):
        assert (ROOT / name).exists(), f"{path.name} names {name}, which does not exist"


def exists(name: str) -> bool:
    """Whether a dotted name is a module, or leads to something from one."""
    thing = importlib.import_module(name.split(".")[0])
    for count, part in enumerate(name.split(".")[1:], start=2):
        if not hasattr(thing, part):
            try:
                importlib.import_module(".".join(name.split(".")[:count]))
            except ModuleNotFoundError:
                return False
        thing = getattr(thing, part)
    return True


def test_code_and_tests_cite_only_benchmarks_that_exist():
    for path in [*python_files(), *(ROOT / "tests").rglob("*.py")]:
        for name in re.findall(r"\b(benchmarks/\w+\.py)", path.read_text(encoding="utf-8")):
            assert (ROOT / name).exists(), f"{path.relative_to(ROOT)} cites {name}, which does not exist"


def test_links_between_the_documents_lead_somewhere():
    for path in documents():
        for target in re.findall(r"\]\(([^)#]+)", path.read_text(encoding="utf-8")):
            if "://" not in target:
                assert (path.parent / target).exists(), f"{path.name} points to {target}, which does not exist"


def test_nothing_that_is_tracked_names_a_single_machine_or_a_package_host():
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("only a git checkout knows what is tracked")
    listed = subprocess.run(["git", "ls-files", "-z"], capture_output=True, text=True, check=True, cwd=ROOT)
    found = []
    for name in filter(None, listed.stdout.split("\0")):
        path = ROOT / name
        if path.suffix in (".png", ".npy") or not path.is_file():
            continue
        hits = OF_ONE_MACHINE.finditer(path.read_text(encoding="utf-8"))
        found += [f"{name}: {hit[0]}" for hit in hits if hit[0] != LOOPBACK or not name.startswith(SERVING)]
    assert not found
