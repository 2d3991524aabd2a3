"""Import of the rooms, the packages beside this one, whatever other packages on the path have their names."""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

ROOMS = ("refract", "geo", "evaluation", "fields", "survey")
_ROOT = Path(__file__).resolve().parent.parent
# Line in the __init__.py of each room.
_MARK = "# Part of bathynerf."


class ForeignPackage(ImportError):
    """A package of another project has the name of one of ours, and its place."""


class _RoomFinder(importlib.abc.MetaPathFinder):
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
    if not any(isinstance(finder, _RoomFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _RoomFinder())


@cache
def require_rooms() -> None:
    """Raise ForeignPackage where a package of another project was installed over a room, or imported in its place."""
    for room in ROOMS:
        place = _imported_from(room)
        if place is not None and place != (_ROOT / room).resolve():
            raise ForeignPackage(
                f"the package {room} of {place} was imported before bathynerf, which has a package of this name; "
                "import bathynerf first, or rename yours"
            )
        init = _ROOT / room / "__init__.py"
        if not init.is_file() or _MARK not in init.read_text(encoding="utf-8", errors="replace"):
            raise ForeignPackage(
                f"{_owner_of(room)} lies in {_ROOT / room}, where bathynerf installs a package of the same name; "
                "install bathynerf in an environment of its own, as uv tool install and pipx install make it"
            )


def _imported_from(room: str) -> Path | None:
    """Folder of a package that is imported already; None of one that is not."""
    places = list(getattr(sys.modules.get(room), "__path__", ()))
    return Path(places[0]).resolve() if places else None


def _owner_of(room: str) -> str:
    """The distribution that a package was installed from, in words."""
    from importlib.metadata import distributions

    for found in distributions(path=[str(_ROOT)]):
        if found.name != "bathynerf" and any(str(file) == f"{room}/__init__.py" for file in found.files or ()):
            return f"{found.name} {found.version} of another project"
    return f"a package {room} of another project"
