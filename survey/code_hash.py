"""A short text for the code that a computation calls: while it is the same, so is what the computation gives.

Comments, docstrings and layout do not count; a file counts only where the computation reaches it by imports, at the
head of files or inside functions. Imports that only type checkers follow do not count.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
from functools import cache, lru_cache
from pathlib import Path

_ROOMS = ("refract", "geo", "evaluation", "fields", "survey")


def code_hash(*modules: str) -> str:
    """SHA-256 over the code of modules and of all modules of this project that they reach by imports.

    Parameters
    ----------
    modules : dotted names, e.g. "survey.run.stage_sweep"

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    ModuleNotFoundError
        If a name is no module of the project.
    """
    reached: set[str] = set()
    waiting = list(modules)
    while waiting:
        name = waiting.pop()
        if name not in reached:
            reached.add(name)
            waiting += _parsed(_file_of(name))[1]
    digest = hashlib.sha256()
    for name in sorted(reached):
        digest.update(f"{name} {_parsed(_file_of(name))[0]}\n".encode())
    return digest.hexdigest()


@cache
def _root(room: str) -> Path:
    spec = importlib.util.find_spec(room)
    if spec is None or not spec.submodule_search_locations:
        raise ModuleNotFoundError(f"{room} is no package of bathynerf")
    return Path(next(iter(spec.submodule_search_locations)))


def _find(name: str) -> Path | None:
    """The file of a module of the project; None where the name is no module, or of another project."""
    room, *rest = name.split(".")
    if room not in _ROOMS:
        return None
    place = _root(room).joinpath(*rest)
    for file in (place.with_suffix(".py"), place / "__init__.py"):
        if file.is_file():
            return file
    return None


def _file_of(name: str) -> Path:
    file = _find(name)
    if file is None:
        raise ModuleNotFoundError(f"{name} is no module of bathynerf")
    return file


def _parsed(file: Path) -> tuple[str, tuple[str, ...]]:
    stat = file.stat()
    return _parse(file, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=1024)
def _parse(file: Path, _modified: int, _size: int) -> tuple[str, tuple[str, ...]]:
    """Hash of a file's code, and the modules of the project that it imports."""
    tree = _WithoutProse().visit(ast.parse(file.read_bytes(), filename=str(file)))
    imported = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            imported += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            names = [f"{node.module}.{alias.name}" for alias in node.names]
            # `from package import module` reaches the module, `from module import name` the module itself.
            imported += [name if _find(name) else node.module for name in names]
    code = hashlib.sha256(ast.dump(tree, annotate_fields=False).encode()).hexdigest()
    return code, tuple(sorted({name for name in imported if _find(name)}))


class _WithoutProse(ast.NodeTransformer):
    """Takes docstrings, and what only type checkers read, out of a syntax tree."""

    def visit_If(self, node: ast.If) -> ast.AST:
        if isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
            return ast.copy_location(ast.Pass(), node)
        return self.generic_visit(node)

    def visit_Expr(self, node: ast.Expr) -> ast.AST:
        if isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            return ast.copy_location(ast.Pass(), node)
        return node
