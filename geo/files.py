"""Files that are written whole or not at all."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from geo.errors import UnreadableFile, UnwritableFile

_MENDS = {
    errno.ENOSPC: "no room is left on the disk; free some or write elsewhere",
    errno.EDQUOT: "the disk quota is used up; free some room or write elsewhere",
    errno.EFBIG: "the file grows larger than this disk or process may write; write elsewhere",
    errno.ENOENT: "its folder does not exist; create it or correct the path",
    errno.ENOTDIR: "its folder is a file; correct the path",
    errno.EISDIR: "a folder has this name; choose another name",
    errno.EACCES: "permission is denied; choose a folder that you may write to",
    errno.EROFS: "the disk is read-only; write elsewhere",
}


@contextmanager
def write_whole(path: str | Path) -> Iterator[BinaryIO]:
    """A binary stream that becomes the file ``path`` when the block ends well.

    Written under a temporary name in the same folder and renamed at the end; after any error the temporary
    file is gone and an older file of that name is untouched.

    Raises
    ------
    UnwritableFile
        If the system refuses (no room, no folder, no permission); the message names the path and the mend.
    """
    path = Path(path)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with part.open("wb") as stream:
                yield stream
                stream.flush()
                os.fsync(stream.fileno())
            part.replace(path)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        mend = _MENDS.get(error.errno, error.strerror or str(error))
        raise UnwritableFile(f"cannot write {path}: {mend}.") from error


def existing_file(path: str | Path) -> Path:
    """The path, if it names a file that is there.

    Raises
    ------
    UnreadableFile
        If nothing is there, or a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise UnreadableFile(f"{path} is a folder; expected a file.")
    if not path.is_file():
        raise UnreadableFile(f"{path} does not exist; correct the path.")
    return path
