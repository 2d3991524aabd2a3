"""Import of the packages beside this one, whatever other packages on the path have their names."""

import importlib.abc
import importlib.machinery
import importlib.util
import sys
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from types import ModuleType

PACKAGES = ("refract", "geo", "evaluation", "fields", "survey")
_ROOT = Path(__file__).resolve().parent.parent
# Line in the __init__.py of each package.
_MARK = "# Part of bathynerf."


class ForeignPackage(ImportError):
    """A package of another project has the name of one of ours, and its place."""


class _PackageFinder(importlib.abc.MetaPathFinder):
    """Finds the packages beside this one and nothing else: not a folder ``survey`` in the working directory."""

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name not in PACKAGES:
            return None
        folder = _ROOT / name
        init = folder / "__init__.py"
        return importlib.util.spec_from_file_location(name, init, submodule_search_locations=[str(folder)])


def find_beside() -> None:
    """Let imports of these packages find those of this installation first."""
    if not any(isinstance(finder, _PackageFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _PackageFinder())


@cache
def require_packages() -> None:
    """Raise ForeignPackage where a package of another project was installed over one of ours, or imported for it."""
    for package in PACKAGES:
        place = _imported_from(package)
        if place is not None and place != (_ROOT / package).resolve():
            raise ForeignPackage(
                f"the package {package} of {place} was imported before bathynerf, which has a package of this name; "
                "import bathynerf first, or rename yours"
            )
        init = _ROOT / package / "__init__.py"
        if not init.is_file() or _MARK not in init.read_text(encoding="utf-8", errors="replace"):
            raise ForeignPackage(
                f"{_owner_of(package)} lies in {_ROOT / package}, where bathynerf installs a package of the same name; "
                "install bathynerf in an environment of its own, as uv tool install and pipx install make it"
            )


def _imported_from(package: str) -> Path | None:
    """Folder of a package that is imported already; None of one that is not."""
    places = list(getattr(sys.modules.get(package), "__path__", ()))
    return Path(places[0]).resolve() if places else None


def _owner_of(package: str) -> str:
    """The distribution that a package was installed from, in words."""
    from importlib.metadata import distributions

    for found in distributions(path=[str(_ROOT)]):
        if found.name != "bathynerf" and any(str(file) == f"{package}/__init__.py" for file in found.files or ()):
            return f"{found.name} {found.version} of another project"
    return f"a package {package} of another project"
