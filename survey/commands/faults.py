"""Errors that end a command, with message and exit code; standard streams that are closed, full, or a broken pipe."""

import io
import os
import sys
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

OUR_BUG, BAD_INPUT, STOPPED, BROKEN_PIPE = 1, 2, 130, 141

# The name in messages.
STANDARD_OUTPUT = "standard output"
# In messages of libraries that get no memory: torch, Dr.Jit, numpy, OpenCV, the C++ library, the loader.
_NO_MEMORY = (
    "out of memory",
    "allocate memory",
    "unable to allocate",
    "failed to allocate",
    "insufficient memory",
    "bad allocation",
    "bad_alloc",
    "failed to map segment from shared object",
)
# The loader reports a disk mounted without permission to execute in the same words.
_NOT_PERMITTED = "not permitted"
_DISK_FULL = ("no space left on device", "disk is full")


@dataclass(frozen=True)
class Fault:
    code: int  # Exit code
    message: str  # For the user; empty if standard output was closed

    @property
    def is_ours(self) -> bool:
        """Whether a traceback is useful."""
        return self.code == OUR_BUG


def fault_of(error: BaseException, place: Path | None = None, *, stopped: str = "") -> Fault:
    """The message and the exit code for an error.

    A system error that names no file names the place; ``stopped`` says what happens to unfinished work after Ctrl-C.
    """
    if is_caused_by(error, KeyboardInterrupt):
        return Fault(STOPPED, f"stopped; {stopped}" if stopped else "stopped")
    if is_caused_by(error, BrokenPipeError):
        return Fault(BROKEN_PIPE, "")
    if any(_is_memory_error(link) for link in _chain(error)):
        remedy = "use --quality draft, a smaller area ([area] bounds, --bounds) or a machine with more memory"
        return Fault(BAD_INPUT, f"memory ran out; {remedy}")
    # Not imported at the top: they take memory, and Ctrl-C may arrive during the import.
    from geo.errors import GeoError
    from survey.errors import SurveyError

    if isinstance(error, GeoError | SurveyError):
        return Fault(BAD_INPUT, str(error).removesuffix("."))
    if isinstance(error, OSError) and (text := disk_error(error, error.filename or place)):
        return Fault(BAD_INPUT, text)
    if any(phrase in str(link).lower() for link in _chain(error) for phrase in _DISK_FULL):
        return Fault(BAD_INPUT, f"cannot write {place}: no space is left on the disk; free some or write elsewhere")
    return Fault(OUR_BUG, f"{type(error).__name__}: {error}; this is a bug in bathynerf, -v shows where")


def disk_error(error: OSError, path: Path | str | None) -> str | None:
    """Message for an error of a disk or file system; None for other errors; see `geo.files.disk_error_text`."""
    from geo.files import disk_error_text

    return disk_error_text(error, path if path is not None else Path(), verb="use")


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    seen: list[BaseException] = []
    while error is not None and error not in seen:
        seen.append(error)
        yield error
        error = error.__cause__ or error.__context__


def is_caused_by(error: BaseException, *kinds: type[BaseException]) -> bool:
    """Whether an error is, or was caused by, one of these kinds."""
    return any(isinstance(link, kinds) for link in _chain(error))


def _is_memory_error(error: BaseException) -> bool:
    if type(error).__module__.partition(".")[0] in ("geo", "survey"):
        return False
    text = str(error).lower()
    return isinstance(error, MemoryError) or (any(word in text for word in _NO_MEMORY) and _NOT_PERMITTED not in text)


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
        from survey.words import printable, wrap_for

        with suppress(OSError):
            sys.stderr.write(f"{wrap_for(printable(message), sys.stderr, label='error: ')}\n")
            sys.stderr.flush()
