"""The Python interface of bathynerf: the commands and their building blocks under one name.

>>> from bathynerf import LocalFrame, Run, Survey, compare, process, simulate

Everything is defined in the packages `survey`, `refract`, `geo`, `fields` and `evaluation`, and imported from there
when it is first used, so that ``import bathynerf`` itself is quick. The names and where they are defined stand in
__init__.pyi, which editors and type checkers read. docs/python.md has examples.
"""

import ast
import importlib
from pathlib import Path
from typing import Any

from bathynerf._packages import find_beside, require_packages

# Module and name there of each name.
_HOME = {
    alias.asname or alias.name: (node.module, alias.name)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom) and node.module is not None
    for alias in node.names
}
__all__ = sorted([*_HOME, "__version__"])
find_beside()


def __getattr__(name: str) -> Any:
    """A name at its first use, from where it is defined."""
    if name == "__version__":
        from importlib.metadata import version

        value: Any = version("bathynerf")
    elif name in _HOME:
        require_packages()
        module, there = _HOME[name]
        value = getattr(importlib.import_module(module), there)
    else:
        raise AttributeError(f"module 'bathynerf' has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
