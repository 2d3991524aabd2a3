"""The packages of the project are found beside this one, whatever else has their names on the path."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType

ROOMS = ("refract", "geo", "evaluation", "fields", "survey")
_ROOT = Path(__file__).resolve().parent.parent


class _Beside(importlib.abc.MetaPathFinder):
    """Finds the rooms, and nothing else: a folder ``survey`` in the working directory is not one of them."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name not in ROOMS:
            return None
        folder = _ROOT / name
        init = folder / "__init__.py"
        return importlib.util.spec_from_file_location(name, init, submodule_search_locations=[str(folder)])


def find_beside() -> None:
    """Let imports of the rooms find those of this installation first."""
    if not any(isinstance(finder, _Beside) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Beside())
