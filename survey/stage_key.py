"""Hash of the inputs of a computation, and of the code that it calls: with equal keys a result is reused.

Comments, docstrings and empty lines do not count; a file counts only where the computation reaches it by imports, at
the head of files or inside functions. Imports that only type checkers follow do not count. The code is read by regular
expressions: the syntax trees of all files take more than a second.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from pyproj import CRS

from survey.errors import SurveyError

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


def stage_key(*parts) -> str:
    """SHA-256 over inputs and settings.

    Parameters
    ----------
    parts
        None, bool, int, float, str; lists, tuples and dicts of parts; dataclasses, by the fields that take
        part in comparison; numpy arrays and scalars; `pyproj.CRS`; `Path` for what a file holds, by its name
        and content (not by where it lies or when it was written, so that a survey may be moved and copied), or
        for what all files of a folder hold.

    Returns
    -------
    str
        64 hexadecimal digits.

    Raises
    ------
    SurveyError
        If a file does not exist or cannot be read.
    TypeError
        If a part is of another kind, e.g. a set, whose order is not fixed.

    Examples
    --------
    >>> stage_key("sweep", {"hypotheses": 64}) == stage_key("sweep", {"hypotheses": 64})
    True
    >>> stage_key(1) == stage_key(1.0)
    False
    """
    digest = hashlib.sha256()
    _feed(digest, parts)
    return digest.hexdigest()


def _feed(digest, part) -> None:
    """Add a part, marked by its kind and length so that no two parts look alike."""
    if isinstance(part, np.generic):
        part = part.item()
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        values = {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if f.compare}
        _mark(digest, "dataclass", type(part).__name__)
        _feed(digest, values)
    elif isinstance(part, np.ndarray):
        if part.dtype.hasobject:
            raise TypeError("stage_key got an array of objects, expected one of numbers")
        _mark(digest, "array", part.dtype.str, part.shape)
        digest.update(np.ascontiguousarray(part).tobytes())
    elif isinstance(part, dict):
        _mark(digest, "dict", len(part))
        for key in sorted(part, key=str):
            _feed(digest, str(key))
            _feed(digest, part[key])
    elif isinstance(part, list | tuple):
        _mark(digest, "list", len(part))
        for item in part:
            _feed(digest, item)
    elif isinstance(part, CRS):
        _mark(digest, "crs", part.to_wkt())
    elif isinstance(part, Path):
        _feed_path(digest, part)
    elif part is None or isinstance(part, bool | int | float | str):
        _mark(digest, type(part).__name__, str(part) if isinstance(part, str) else repr(part))
    else:
        raise TypeError(f"stage_key got {type(part).__name__}, expected numbers, texts, arrays, dataclasses or paths")


def _feed_path(digest, path: Path) -> None:
    try:
        if path.is_dir():
            files = sorted(p for p in path.rglob("*") if p.is_file())
            _mark(digest, "folder", len(files))
            for file in files:
                _mark(digest, "name", file.relative_to(path).as_posix())
                _feed_path(digest, file)
            return
    except OSError as error:
        raise _unread(path, error) from error
    _mark(digest, "file", path.name, content_hash(path))


def content_hash(path: Path) -> str:
    """SHA-256 of what a file holds; the same file is read once in a process.

    Raises
    ------
    SurveyError
        If it cannot be read.
    """
    try:
        stat = path.stat()
        return _content(path, stat.st_ctime_ns, stat.st_size)
    except OSError as error:
        raise _unread(path, error) from error


def _unread(path: Path, error: OSError) -> SurveyError:
    return SurveyError(f"cannot read {path} ({error.strerror}); put the file back or correct it")


@lru_cache(maxsize=1 << 16)
def _content(path: Path, _changed: int, _size: int) -> str:
    """Hash of a file; the same file is read once in a process, for structure from motion and for the sweep.

    The time of the last change of its inode, unlike that of its content, cannot be set by a program that copies.
    """
    with path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _mark(digest, *words) -> None:
    digest.update(json.dumps(words).encode() + b"\n")


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
        If a name is not a module of the project.
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
    """The file of a module of the project; None where the name is not a module, or of another project.

    Remembered for one hash, in which each name is asked for ten times.
    """
    room, *parts = name.split(".")
    if room not in _ROOMS:
        return None
    place = _ROOT.joinpath(room, *parts)
    for file in (place.with_suffix(".py"), place / "__init__.py"):
        if file.is_file():
            return file
    return None


def _file_of(name: str) -> Path:
    file = _find(name)
    if file is None:
        raise ModuleNotFoundError(f"{name} is not a module of bathynerf")
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
