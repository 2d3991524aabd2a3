"""Hash of the inputs of a computation, and of the code of this project: with equal keys a result is reused."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from pyproj import CRS

from survey.errors import SurveyError

# All packages lie beside each other, wherever they are installed; names are not looked up on the path: a working
# directory may have a folder called survey.
_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("refract", "geo", "evaluation", "fields", "survey")


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
    """SHA-256 of what a file holds; the same file is read once in a process."""
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


@cache
def code_hash() -> str:
    """SHA-256 over the code of this project; taken once in a process, as files may change later."""
    digest = hashlib.sha256()
    for file in sorted(file for name in _PACKAGES for file in (_ROOT / name).rglob("*.py")):
        _mark(digest, file.relative_to(_ROOT).as_posix(), hashlib.sha256(file.read_bytes()).hexdigest())
    return digest.hexdigest()
