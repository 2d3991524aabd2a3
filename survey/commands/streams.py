"""Standard output and error that may be closed, full, or a pipe whose reader has gone."""

from __future__ import annotations

import io
import os
import sys
from contextlib import suppress


def open_closed() -> None:
    """Open what the caller closed (``>&-``) on the null device.

    Otherwise the first file that is opened would get the number of the stream, and with it what libraries print.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    for stream in (sys.stdout, sys.stderr):
        # A name of a file need not be text in the encoding of the terminal.
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def flush_all() -> OSError | None:
    """Flush both streams; the error of standard output, if there was one.

    A stream that does not take its rest is led to the null device, or the interpreter would complain at its end.
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
    """Write a sentence to standard error; nothing if it is empty, or if nobody can be told."""
    if message:
        with suppress(OSError):
            sys.stderr.write(f"error: {message}\n")
            sys.stderr.flush()
