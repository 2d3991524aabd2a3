"""Files written completely or not at all, messages for errors of the disk, and the libraries of optional formats.

These libraries are extras of the distribution, imported when a file needs one.
"""

import errno
import glob
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np

from geo.errors import UnreadableFile, UnwritableFile

_NO_PERMISSION = "permission is denied; change its permissions or choose another folder"
_REMEDIES = {
    errno.ENOSPC: "no space is left on the disk; free some or write elsewhere",
    errno.EDQUOT: "the disk quota is used up; free some room or write elsewhere",
    errno.EFBIG: "the file grows larger than this disk or process may write; write elsewhere",
    errno.ENOENT: "its folder does not exist; create it or correct the path",
    errno.ENOTDIR: "its folder is a file; correct the path",
    errno.EEXIST: "a file is in the way; choose another name",
    errno.EISDIR: "a folder has this name; choose another name",
    errno.EACCES: _NO_PERMISSION,
    errno.EPERM: _NO_PERMISSION,
    errno.EROFS: "the disk is read-only; write elsewhere",
    errno.ELOOP: "its links lead in a circle; correct them",
    errno.ENAMETOOLONG: "the name is too long; shorten it",
    errno.ENOLCK: "its disk cannot lock files; choose a folder on another disk",
    errno.ENOTSUP: "its disk does not support this; choose a folder on another disk",
    errno.EMFILE: "too many files are open; raise the limit (ulimit -n)",
    errno.EIO: "the disk reports a fault (input/output error); check it or write elsewhere",
}
# For an error that may have come from reading.
_REMEDIES_OF_USE = _REMEDIES | {
    errno.ENOENT: "it does not exist; correct the path",
    errno.ENOTDIR: "a part of the path is a file; correct the path",
    errno.EISDIR: "it is a folder; name a file",
}
_ONLY_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
# numpy and Pillow lose the error number: with less free space than this, the cause is taken to be a full disk.
_NO_ROOM_BYTES = 1 << 20
# Bytes written at a time where the system cannot reserve disk space.
_ZEROS = 1 << 24
# Endings of files that other programs read with a file of a suffix, behind its name or, with a star, in place of the
# suffix: statistics, overviews, masks and places of rasters, journals of SQLite, an index of points, types of columns.
# Of a file that is replaced they state what no longer holds.
_SHARED = ("*.aux", "*.wld", "*.prj")
_RASTER = (".aux.xml", ".ovr", ".msk", ".msk.ovr", "*.rrd", *_SHARED)
_BESIDE = {
    ".tif": (*_RASTER, "*.tfw", "*.tifw"),
    ".tiff": (*_RASTER, "*.tfw", "*.tifw", "*.tiffw"),
    ".bag": _RASTER,
    ".xyz": _RASTER,
    ".png": (*_RASTER, "*.pgw", "*.pngw"),
    ".gpkg": (".aux.xml", "-wal", "-shm", "-journal"),
    ".las": ("*.lax",),
    ".laz": ("*.lax",),
    ".csv": ("*.csvt", "*.prj"),
}


def disk_error_text(error: OSError, path: str | Path, *, verb: str = "write") -> str | None:
    """An error of the operating system as one sentence with the path and a remedy; None if it is not about a disk.

    The verb is "use" where it is not known whether the path was to be read or written.
    """
    number = error.errno
    if number is None and _is_full(Path(path)):
        number = errno.ENOSPC
    if number in _ONLY_WRITING:
        verb = "write"
    remedies = _REMEDIES if verb == "write" else _REMEDIES_OF_USE
    remedy = None if number is None else remedies.get(number)
    return None if remedy is None else f"cannot {verb} {path}: {remedy}"


@contextmanager
def reporting_disk_errors(path: str | Path) -> Iterator[None]:
    """Turn every OSError in the block into an UnwritableFile, which names the path if the error names none."""
    try:
        yield
    except OSError as error:
        raise _unwritable(error, error.filename or path) from error


@contextmanager
def write_whole(path: str | Path) -> Iterator[BinaryIO]:
    """A binary stream, to write and to read back, that becomes the file ``path`` when the block ends well.

    After an error an older file of that name is untouched. A symbolic link is followed, as by `cp`; into a device or a
    pipe, e.g. /dev/stdout, the bytes go at once, and cannot be read back.
    """
    path = Path(path)
    try:
        if path.exists() and not path.is_file() and not path.is_dir():
            with path.open("wb") as stream:
                yield stream
            return
        with write_whole_at(path) as part, part.open("w+b") as stream:
            yield stream
            stream.flush()
            os.fsync(stream.fileno())
    except OSError as error:
        raise _unwritable(error, path) from error


def write_text(path: str | Path, text: str) -> None:
    """Write a text file in UTF-8, whole or not at all."""
    with write_whole(path) as stream:
        stream.write(text.encode())


@contextmanager
def write_whole_at(path: str | Path) -> Iterator[Path]:
    """Path of a temporary file for libraries that write by path; otherwise as `write_whole`.

    Files beside the replaced one that state what it held, e.g. NAME.aux.xml, go with it.
    """
    path = Path(path)
    target = Path(os.path.realpath(path))
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        try:
            yield part
            # Before, so that no program reads the new file with them.
            for old in _stale(target):
                old.unlink(missing_ok=True)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise _unwritable(error, path) from error


def _stale(path: Path) -> list[Path]:
    """Places beside a file, whether they exist or not, of what other programs read with it."""
    endings = _BESIDE.get(path.suffix.lower(), ())
    places = [path.with_suffix(end[1:]) if end[0] == "*" else path.with_name(path.name + end) for end in endings]
    # These may belong to another file of that stem, as NAME.prj to NAME.shp.
    own = {path.name, f"{path.stem}.qml", *(place.name for place in places)}
    same_stem = (file.name for file in path.parent.glob(f"{glob.escape(path.stem)}.*") if file.stem == path.stem)
    others = not own.issuperset(same_stem)
    return [place for end, place in zip(endings, places, strict=True) if not (others and end in _SHARED)]


def beside_that_keeps(path: Path) -> str | None:
    """Why a file must not be replaced for what lies beside it, as the end of a sentence; None where it may be."""
    # Journals of SQLite with changes that are not yet in the file.
    for ending in ("-wal", "-journal"):
        journal = path.with_name(path.name + ending)
        if path.exists() and journal.is_file() and journal.stat().st_size:
            return (
                f"but {journal.name} holds changes that another program has not written into it yet; close that "
                "program, or remove it"
            )
    # What people have written about a file in QGIS.
    described = path.with_suffix(".qmd")
    if path.exists() and described.is_file():
        return f"which {described.name} describes; remove or rename that file"
    return None


def scratch_array(path: Path, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """An array of zeros in a memory-mapped scratch file, whose disk space is reserved: a full disk ends the process."""
    size = int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
    try:
        with path.open("wb") as stream:
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(stream.fileno(), 0, max(size, 1))
            else:
                for first in range(0, size, _ZEROS):
                    stream.write(bytes(min(_ZEROS, size - first)))
    except OSError as error:
        reason = error.strerror or str(error)
        raise UnwritableFile(
            f"cannot write {path}: scratch of {size / 1e6:.0f} MB does not fit into {path.parent} ({reason}); free "
            "some room, or name another folder in the environment variable TMPDIR."
        ) from error
    return np.memmap(path, dtype=dtype, mode="r+", shape=shape)


def existing_file(path: str | Path) -> Path:
    """The path, if it names a file that is there."""
    path = Path(path)
    if path.is_dir():
        raise UnreadableFile(f"{path} is a folder; expected a file.")
    if not path.is_file():
        raise UnreadableFile(f"{path} does not exist; correct the path.")
    return path


def _unwritable(error: OSError, path: str | Path) -> UnwritableFile:
    # What is written may come from other files: of these an error names another folder.
    named = Path(error.filename) if isinstance(error.filename, str) else None
    if named is not None and named.absolute().parent not in (Path(path).absolute().parent, Path(path).resolve().parent):
        text = disk_error_text(error, named, verb="use") or f"cannot use {named}: {error.strerror or error}"
        return UnwritableFile(f"cannot write {path}: {text}.")
    text = disk_error_text(error, path) or f"cannot write {path}: {error.strerror or error}; write elsewhere"
    return UnwritableFile(f"{text}.")


def _is_full(path: Path) -> bool:
    """Whether the disk that has, or would have, a path has no room left."""
    for place in (path, *path.absolute().parents):
        if place.exists():
            return shutil.disk_usage(place).free < _NO_ROOM_BYTES
    return False


def library_for(path: str | Path, module: str, extra: str, *, to_write: bool = False) -> ModuleType:
    """The module that reads, or writes, a file."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        verb, remedy = ("written", "name") if to_write else ("read", "export it in")
        raise (UnwritableFile if to_write else UnreadableFile)(
            f"{path} is {verb} by {module.split('.')[0]}, which is not installed: pip install 'bathynerf[{extra}]', or "
            f"{remedy} another format."
        ) from error
