"""Standard output and error, which may be closed, full, or a broken pipe."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress


def open_closed() -> None:
    """Open standard streams that the caller closed (``>&-``) on the null device.

    Otherwise the first file that is opened would get file descriptor 1 or 2 and receive library output.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        # A file name may contain characters that the terminal's encoding lacks.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def flush_all() -> OSError | None:
    """Flush both streams; returns the error of standard output, if there was one.

    A stream that cannot be flushed is redirected to the null device, so that Python does not report it again at exit.
    """
    errors: list[OSError | None] = []
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
            errors.append(None)
        except OSError as error:
            errors.append(error)
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    return errors[0]


def say_error(message: str) -> None:
    """Write a message to standard error, unless it is empty or standard error cannot be written."""
    if message:
        from survey.lines import fitted

        with suppress(OSError):
            sys.stderr.write(f"{fitted(message, sys.stderr, label='error: ')}\n")
            sys.stderr.flush()
