"""The glossary in CONVENTIONS.md: every name that it gives is one of the code."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
ROWS = re.findall(r"^\| ([^|]+) \|[^|]*\|[^|]*\| `([\w.]+)`[^|]*\|", (ROOT / "CONVENTIONS.md").read_text("utf-8"), re.M)
NAMES = [name for _, name in ROWS if name.split(".")[0] in ("refract", "geo", "evaluation", "fields", "survey")]


def _names_in(body: list[ast.stmt]) -> dict[str, list[ast.stmt]]:
    """Names that statements bind, with the bodies of classes."""
    found: dict[str, list[ast.stmt]] = {}
    for node in body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found[node.name] = node.body if isinstance(node, ast.ClassDef) else []
        elif isinstance(node, ast.Assign):
            found |= {each.id: [] for each in ast.walk(node) if isinstance(each, ast.Name)}
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found[node.target.id] = []
    return found


@pytest.mark.parametrize("name", NAMES)
def test_a_name_of_the_glossary_is_in_the_code(name):
    parts = name.split(".")
    depth = max(i for i in range(1, len(parts)) if (ROOT / "/".join(parts[:i])).with_suffix(".py").is_file())
    body = ast.parse((ROOT / "/".join(parts[:depth])).with_suffix(".py").read_text("utf-8")).body
    for part in parts[depth:]:
        names = _names_in(body)
        assert part in names, f"{name}: no {part}"
        body = names[part]


def test_the_glossary_is_read():
    assert len(NAMES) > 30


def test_files_that_contributing_names_exist():
    text = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    named = set(re.findall(r"`((?:refract|geo|evaluation|fields|survey|tests)/[\w/]+\.py)`", text))
    assert sorted(name for name in named if not (ROOT / name).is_file()) == []
