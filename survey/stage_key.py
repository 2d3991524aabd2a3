"""Hash of the inputs of a computation, and of the code of this project: with equal keys a result is reused."""

import dataclasses
import hashlib
import json
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from pyproj import CRS

from survey.errors import SurveyError

# All packages lie beside each other, wherever they are installed; names are not looked up on the path: a working
# directory may have a folder called survey.
_ROOT = Path(__file__).resolve().parent.parent
_PACKAGES = ("refract", "geo", "evaluation", "fields", "survey")


def stage_key(*parts) -> str:
    """SHA-256, 64 hexadecimal digits, over inputs and settings.

    Parts are None, bool, int, float, str; lists, tuples and dicts of parts; dataclasses, by the fields that take part
    in comparison; numpy arrays and scalars; `pyproj.CRS`; `Path` for what a file holds, by its name and content (not by
    where it lies or when it was written, so that a survey may be moved and copied), or all files of a folder.

    >>> stage_key("sweep", {"hypotheses": 64}) == stage_key("sweep", {"hypotheses": 64})
    True
    >>> stage_key(1) == stage_key(1.0)
    False
    """
    return _digest(json.dumps(parts, sort_keys=True, default=_plain).encode())


def _plain(part: Any) -> Any:
    """A part in terms that JSON has, marked by its kind so that no two parts look alike."""
    if isinstance(part, np.generic):
        return part.item()
    if dataclasses.is_dataclass(part) and not isinstance(part, type):
        values = {f.name: getattr(part, f.name) for f in dataclasses.fields(part) if f.compare}
        return {f"dataclass {type(part).__name__}": values}
    if isinstance(part, np.ndarray):
        if part.dtype.hasobject:
            raise TypeError("stage_key got an array of objects, expected one of numbers")
        return {f"array {part.dtype.str}": [part.shape, _digest(np.ascontiguousarray(part).tobytes())]}
    if isinstance(part, CRS):
        return {"crs": part.to_wkt()}
    if not isinstance(part, Path):
        raise TypeError(f"stage_key got {type(part).__name__}, expected numbers, texts, arrays, dataclasses or paths")
    try:
        if part.is_dir():
            files = sorted(path for path in part.rglob("*") if path.is_file())
            return {"folder": [[path.relative_to(part).as_posix(), path] for path in files]}
    except OSError as error:
        raise _unread(part, error) from error
    return {"file": [part.name, content_hash(part)]}


def _digest(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


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


@cache
def code_hash() -> str:
    """SHA-256 over the code of this project; taken once in a process, as files may change later."""
    files = sorted(path for name in _PACKAGES for path in (_ROOT / name).rglob("*.py"))
    return _digest(
        json.dumps([[path.relative_to(_ROOT).as_posix(), _digest(path.read_bytes())] for path in files]).encode()
    )
