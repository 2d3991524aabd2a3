"""The Python interface: every name leads to what it says, and importing it costs next to nothing."""

from __future__ import annotations

import ast
import importlib
import importlib.metadata
import subprocess
import sys
from pathlib import Path

import pytest

import bathynerf

FILE = Path(bathynerf.__file__)


def for_editors() -> dict[str, tuple[str, str]]:
    """Module and name there of each name that the file imports for type checkers alone."""
    tree = ast.parse(FILE.read_text(encoding="utf-8"))
    (block,) = (n for n in tree.body if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING")
    imports = [node for node in block.body if isinstance(node, ast.ImportFrom)]
    return {alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names}


def test_the_names_for_editors_are_the_public_names():
    assert sorted([*for_editors(), "__version__"]) == bathynerf.__all__ == dir(bathynerf)


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
