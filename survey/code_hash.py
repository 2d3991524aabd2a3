"""Hash of the code that a computation calls: equal hashes, equal results.

Comments, docstrings and empty lines do not count; a file counts only where the computation reaches it by imports, at
the head of files or inside functions. Imports that only type checkers follow do not count. The code is read by regular
expressions: the syntax trees of all files take more than a second.
"""

from __future__ import annotations

import hashlib
import re
from functools import cache, lru_cache
from pathlib import Path

# All rooms lie beside each other, wherever they are installed; names are not looked up on the path: a working directory
# may have a folder called survey.
_ROOT = Path(__file__).resolve().parent.parent
_ROOMS = ("refract", "geo", "evaluation", "fields", "survey")
# What is left out (docstrings; comments and empty lines at the end of a line), and strings, which are kept: what looks
# like a comment in them is none.
_LONG, _SHORT = r'"""(?:[^"\\]|\\.|"(?!""))*+"""', r'"(?:[^"\\\n]|\\.)*+"|\'(?:[^\'\\\n]|\\.)*+\''
_ENDS = r" *+(?:#[^\n]*)?\n"
_PROSE = re.compile(rf"(?:\A|(?<=:\n)) *{_LONG}|(?P<kept>{_LONG}|{_SHORT})|(?P<end>(?:{_ENDS})+)", re.DOTALL)
_TYPES_ONLY = re.compile(r"^if TYPE_CHECKING:\n(?:(?: +[^\n]*)?\n)+", re.MULTILINE)
_IMPORT = re.compile(r"^ *(?:from ([\w.]+) import (\([^)]*\)|[^\n(]*)|import ([^\n]+))", re.MULTILINE)


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
    _find.cache_clear()
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
def _find(name: str) -> Path | None:
    """The file of a module of the project; None where the name is no module, or of another project.

    Remembered for one hash, in which each name is asked for ten times.
    """
    room, *rest = name.split(".")
    if room not in _ROOMS:
        return None
    place = _ROOT.joinpath(room, *rest)
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
    code = without_prose(file.read_text(encoding="utf-8"))
    return hashlib.sha256(code.encode()).hexdigest(), tuple(sorted(modules_imported(code)))


def without_prose(text: str) -> str:
    """Source text without docstrings, comments, empty lines and what only type checkers read."""
    return _TYPES_ONLY.sub("", _PROSE.sub(lambda part: part["kept"] or ("\n" if part["end"] else ""), text))


def modules_imported(code: str) -> set[str]:
    """The modules of the project that code (`without_prose`) imports, by their dotted names."""
    imported = set()
    for package, taken, modules in _IMPORT.findall(code):
        names = [name.split(" as ")[0].strip() for name in (taken or modules).strip("()").split(",")]
        # Nothing follows the last comma of names in brackets.
        names = [name for name in names if name]
        if package:
            # `from package import module` reaches the module, `from module import name` the module itself.
            names = [f"{package}.{name}" if _find(f"{package}.{name}") else package for name in names]
        imported |= {name for name in names if _find(name)}
    return imported
