"""The hash of the code of a stage, on a copy of the code that is edited."""

from __future__ import annotations

import ast
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

from survey.run.pipeline import LOADING
from survey.stage_key import code_hash, modules_imported, without_prose

ROOT = Path(__file__).resolve().parent.parent
SWEEP, BED = "survey.run.stage_sweep", "survey.run.stage_bed"
# Loaded by the device that is chosen: both implementations count.
KERNELS = ("rays", "drjit_kernels", "drjit_scoring", "torch_kernels")
A_LINE = ("from __future__ import annotations", "from __future__ import annotations\nX = 1")


@pytest.fixture(scope="module")
def copy(tmp_path_factory):
    """A copy of the rooms."""
    folder = tmp_path_factory.mktemp("copy")
    for room in ("refract", "geo", "evaluation", "fields", "survey"):
        shutil.copytree(ROOT / room, folder / room, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@cache
def code_hash_of(folder: Path) -> Callable[..., str]:
    """The function of a copy's own file."""
    spec = spec_from_file_location("code_hash_of_copy", folder / "survey" / "stage_key.py")
    copied = module_from_spec(spec)
    spec.loader.exec_module(copied)
    return copied.code_hash


def hashes_in(folder: Path) -> dict[str, str]:
    """The hashes of both stages' code in a copy."""
    return {name: code_hash_of(folder)(name, *LOADING) for name in (SWEEP, BED)}


@pytest.fixture(scope="module")
def first(copy):
    return hashes_in(copy)


@pytest.fixture
def edit(copy):
    """A function that replaces text in a file of the copy, undone at the end."""
    before = {}

    def replace(name: str, old: str, new: str) -> None:
        path = copy / name
        text = path.read_text(encoding="utf-8")
        before.setdefault(path, text)
        assert old in text, f"{name} has no {old!r}"
        path.write_text(text.replace(old, new), encoding="utf-8")

    yield replace
    for path, text in before.items():
        path.write_text(text, encoding="utf-8")


@pytest.mark.parametrize(
    ("name", "old", "new", "changed"),
    [
        ("survey/photos/images.py", "cv2.INTER_AREA", "cv2.INTER_LINEAR", (SWEEP, BED)),
        ("survey/plan/heights.py", "HIGHEST, DEEPEST = 0.8, 1.5", "HIGHEST, DEEPEST = 0.8, 1.4", (SWEEP, BED)),
        ("fields/sweep/passes.py", "Pass(0.5, 2, 11,", "Pass(0.5, 2, 13,", (SWEEP, BED)),
        ("fields/slab/novel_view.py", "CHUNK = 65536", "CHUNK = 32768", (BED,)),
        ("refract/kernels.py", *A_LINE, (SWEEP, BED)),
        *((f"fields/sweep/kernels/{name}.py", *A_LINE, (SWEEP, BED)) for name in KERNELS),
        ("survey/photos/images.py", *A_LINE, (SWEEP, BED)),
    ],
)
def test_a_stage_depends_on_the_code_that_it_calls(copy, first, edit, name, old, new, changed):
    edit(name, old, new)
    after = hashes_in(copy)
    found = {module for module in first if first[module] != after[module]}
    assert found == set(changed)


def test_a_stage_depends_on_no_other_code(copy, first, edit):
    # Comments, docstrings and empty lines decide nothing.
    edit("fields/sweep/fusion.py", "PEERS = 12", "# Some views.\n\nPEERS = 12  # views")
    edit("fields/sweep/sweep.py", '"""Refractive plane sweep', '"""The plane sweep')
    # Nor does code that a stage never reaches: other fields, reports, recipes.
    edit("fields/volume/sdf.py", *A_LINE)
    edit("survey/report/page.py", *A_LINE)
    edit("survey/plan/recipe.py", "(4, 4)", "(5, 4)")
    assert hashes_in(copy) == first


@pytest.mark.parametrize("room", ["refract", "geo", "evaluation", "fields", "survey"])
def test_the_imports_of_each_file_are_those_of_its_syntax_tree(room):
    for file in (ROOT / room).rglob("*.py"):
        code = without_prose(file.read_text(encoding="utf-8"))
        tree = ast.parse(file.read_text(encoding="utf-8"))
        assert modules_imported(code) == imports_in(for_running(tree)), file


def for_running(tree: ast.Module) -> ast.Module:
    """A module without the imports at its head that only type checkers follow."""
    body = [node for node in tree.body if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING")]
    return ast.Module(body, [])


def imports_in(tree: ast.Module) -> set[str]:
    """Modules of the project."""
    found = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names if is_module(alias.name)}
        elif isinstance(node, ast.ImportFrom):
            of_package = {f"{node.module}.{alias.name}" for alias in node.names}
            modules = {name if is_module(name) else str(node.module) for name in of_package}
            found |= {name for name in modules if is_module(name)}
    return found


def is_module(name: str) -> bool:
    place = ROOT.joinpath(*name.split("."))
    is_ours = name.split(".")[0] in ("refract", "geo", "evaluation", "fields", "survey")
    return is_ours and (place.with_suffix(".py").is_file() or (place / "__init__.py").is_file())


def test_a_string_that_looks_like_a_comment_counts(copy, edit):
    edit("fields/sweep/fusion.py", "PEERS = 12", 'PEERS = 12\nTEXT = "# one"')
    one = hashes_in(copy)
    edit("fields/sweep/fusion.py", "# one", "# two")
    assert hashes_in(copy)[SWEEP] != one[SWEEP]


def test_a_name_that_is_no_module_of_the_project_is_refused():
    with pytest.raises(ModuleNotFoundError, match=r"survey\.gone is not a module"):
        code_hash("survey.gone")
    with pytest.raises(ModuleNotFoundError, match="json is not a module"):
        code_hash("json")


def test_folders_with_the_names_of_rooms_in_the_working_directory_are_not_in_the_way(tmp_path):
    for name in ("refract", "geo", "evaluation", "fields", "survey"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "notes.txt").write_text("no package\n")
    (tmp_path / "survey" / "sfm.py").write_text("raise ImportError\n")
    code = (
        "import bathynerf; from bathynerf import load_survey; from survey.stage_key import code_hash;"
        "print(code_hash('survey.sfm.solve'))"
    )
    command = [sys.executable, "-c", code]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    shown = subprocess.run(command, capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.strip() == code_hash("survey.sfm.solve")
