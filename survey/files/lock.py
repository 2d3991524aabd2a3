"""A lock file: one process at a time works in a folder."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from survey.errors import SurveyError

NAME = ".lock"


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
    path = folder / NAME
    lock = _opened(path, busy)
    try:
        lock.truncate(0)
        lock.write(str(os.getpid()).encode())
        lock.flush()
        yield
    finally:
        path.unlink(missing_ok=True)
        lock.close()


def _opened(path: Path, busy: str) -> BinaryIO:
    """The lock file, open and locked."""
    while True:
        lock = path.open("a+b")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Its last owner may have removed the file after it was opened here, and another one may have made it anew.
            if path.stat().st_ino == os.fstat(lock.fileno()).st_ino:
                return lock
        except FileNotFoundError:
            pass
        except BlockingIOError as error:
            lock.seek(0)
            pid = lock.read().decode(errors="replace").strip() or "unknown"
            lock.close()
            raise SurveyError(busy.format(pid=pid)) from error
        except OSError:
            lock.close()
            raise
        lock.close()
