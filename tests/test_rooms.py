"""The rooms: who may import whom, who may touch the disk and the console, and what each room offers."""

from __future__ import annotations

import ast
import importlib
from fnmatch import fnmatch
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
MAY_IMPORT = {
    "refract": set(),
    "geo": set(),
    "evaluation": set(),
    "fields": {"refract"},
    "survey": {"refract", "geo", "evaluation", "fields"},
}
OUTSIDE = {"tests", "benchmarks", "docs"}
TOUCH_DISK = {"geo", "survey"}
CONSOLE = {"survey/commands/*", "survey/progress.py"}
DISK = {"open", ".open", ".write_text", ".write_bytes", ".read_text", ".read_bytes", ".unlink", ".mkdir"} | {
    f"{module}.{verb}" for module in ("np", "torch") for verb in ("save", "load", "savez", "savetxt", "loadtxt")
}
NETWORK = {"socket", "urllib", "http", "requests", "ftplib"}
FILES = sorted(path for room in MAY_IMPORT for path in (ROOT / room).rglob("*.py"))


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), filename=str(path))


def imported(tree: ast.Module) -> set[str]:
    """Dotted names of all modules that a file imports, at its head or inside functions."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module)
    return names


def called(tree: ast.Module) -> set[str]:
    """Names that a file calls: ``open``, ``print``, and the last part of ``a.b.c()`` with a dot before it."""
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Call):
            target = node.func
            if isinstance(target, ast.Name):
                names.add(target.id)
            elif isinstance(target, ast.Attribute):
                names.add("." + target.attr)
                if isinstance(target.value, ast.Name):
                    names.add(f"{target.value.id}.{target.attr}")
    return names


def test_every_room_is_there():
    for room in MAY_IMPORT:
        assert (ROOT / room / "__init__.py").is_file(), f"{room} has no __init__.py"
    assert len(FILES) >= 20


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_a_file_imports_only_the_rooms_below_its_own(path):
    room = path.relative_to(ROOT).parts[0]
    rooms = {name.split(".")[0] for name in imported(tree_of(path))} & (MAY_IMPORT.keys() | OUTSIDE)
    extra = rooms - MAY_IMPORT[room] - {room}
    assert not extra, f"{name_of(path)} imports {sorted(extra)}; {room} may import {sorted(MAY_IMPORT[room])}"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_only_geo_and_survey_touch_the_disk(path):
    if path.relative_to(ROOT).parts[0] in TOUCH_DISK:
        return
    found = called(tree_of(path)) & DISK
    assert not found, f"{name_of(path)} calls {sorted(found)}; only geo and survey touch the disk"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_only_commands_and_progress_touch_the_console(path):
    if any(fnmatch(name_of(path), pattern) for pattern in CONSOLE):
        return
    tree = tree_of(path)
    found = called(tree) & {"print", "input", "sys.exit", "exit", "quit", "typer.echo", "Console"}
    found |= {name for name in imported(tree) if name.split(".")[0] in {"rich", "typer", "click"}}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and ast.unparse(node) in {"sys.stdout", "sys.stderr"}:
            found.add(ast.unparse(node))
    assert not found, f"{name_of(path)} uses {sorted(found)}; only {sorted(CONSOLE)} touch the console"


@pytest.mark.parametrize("path", FILES, ids=name_of)
def test_nothing_reaches_for_the_network(path):
    found = {name for name in imported(tree_of(path)) if name.split(".")[0] in NETWORK}
    assert not found, f"{name_of(path)} imports {sorted(found)}; a survey is processed without a network"


@pytest.mark.parametrize("room", MAY_IMPORT)
def test_every_public_name_of_a_room_can_be_imported(room):
    module = importlib.import_module(room)
    names = getattr(module, "__all__", [])
    assert len(names) == len(set(names))
    assert sorted(name for name in names if not hasattr(module, name)) == []


def test_the_walk_sees_what_it_forbids():
    tree = ast.parse("def f():\n    from survey.commands import app\n    p.write_text(open(q))\n    sys.exit(print())")
    assert imported(tree) == {"survey.commands"}
    assert {"open", ".write_text", "sys.exit", "print"} <= called(tree)
