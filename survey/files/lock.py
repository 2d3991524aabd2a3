"""A lock file: one process at a time works in a folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from survey.errors import SurveyError

# The file that the system locks, and beside it the number of the process: where a lock keeps others from reading
# (Windows), the file itself cannot tell.
NAME, OWNER = ".lock", ".lock.pid"


@contextmanager
def locked(folder: Path, *, busy: str) -> Iterator[None]:
    """Hold the lock of a folder, which exists, for a block; the system frees it when the process ends, however it ends.

    Parameters
    ----------
    folder : Path
    busy : str
        The message where another process has the lock; ``{pid}`` in it is that process's number.

    Raises
    ------
    SurveyError
        If another process has the lock.
    """
    path, owner = folder / NAME, folder / OWNER
    lock = FileLock(path, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        raise SurveyError(busy.format(pid=_number_in(owner))) from error
    try:
        owner.write_text(str(os.getpid()), encoding="ascii")
        yield
    finally:
        owner.unlink(missing_ok=True)
        # Where an open file can be removed: one who waits for it finds that it has gone, and makes it anew.
        with suppress(PermissionError):
            path.unlink(missing_ok=True)
        lock.release()


def _number_in(owner: Path) -> str:
    try:
        return owner.read_text(encoding="ascii").strip() or "unknown"
    except (OSError, ValueError):
        return "unknown"
