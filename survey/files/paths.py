"""Checks of paths: of what others bring, of outputs, one rule for every command; and the lock of a folder.

No pipe or device is read; a file that is not read by its name says what to give instead. Of outputs:

- The folder of a named file has to exist; a folder that is named (-o DIR) is made, with those above it.
- No output is a file that the command reads, under whatever name, nor lies in a folder of them.
- A file that is already there is replaced only where it is of the kind that would be written, and not write-protected;
  with it go the files beside it that state what it held (`geo.files`).
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from tempfile import TemporaryFile

from filelock import FileLock, Timeout

from geo.files import beside_that_keeps
from survey.errors import OutputError, SurveyError

# Longer than every head by which a kind of file is known.
_HEAD_BYTES = 2048
# The file that the system locks, and beside it the number of the process: where a lock keeps others from reading
# (Windows), the file itself cannot tell.
LOCK_FILE, LOCK_OWNER = ".lock", ".lock.pid"


def require_plain_entries(folder: Path) -> None:
    """Raise SurveyError where a folder holds, at any depth, something that is neither a file nor a folder."""
    for place, folders, files in os.walk(folder):
        require_plain(Path(place, name) for name in (*folders, *files))


def require_plain(paths: Iterable[Path]) -> None:
    """Raise SurveyError where one of paths exists and is, or leads to, neither a file nor a folder."""
    for path in paths:
        # Reading a pipe or a device may not end.
        if not path.is_file() and not path.is_dir() and path.exists():
            raise SurveyError(f"{path} is a pipe, a socket or a device, expected a file or folder; remove it")


def instead_of(path: Path, not_read: Mapping[str, str]) -> str | None:
    """What to do instead of giving a file or folder, by patterns of names in lower case; None for other names."""
    name = path.name.casefold()
    return next((instead for pattern, instead in not_read.items() if fnmatchcase(name, pattern)), None)


def begins_with(path: Path, sign: bytes) -> bool:
    """Whether a file begins with a sign, behind a byte order mark and blanks."""
    with path.open("rb") as file:
        return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(sign)


@dataclass(frozen=True)
class ReadFiles:
    files: tuple[Path, ...] = ()  # Those that do not exist are not input
    folders: tuple[Path, ...] = ()  # Everything in them and below them is read

    @classmethod
    def of(cls, *paths: Path | None) -> ReadFiles:
        """Sorts paths into files and folders; None is an option that was not given."""
        given = [path for path in paths if path is not None]
        files = tuple(path for path in given if path.is_file())
        return cls(files, tuple(path for path in given if path.is_dir()))

    def __add__(self, other: ReadFiles) -> ReadFiles:
        return ReadFiles(self.files + other.files, self.folders + other.folders)

    def same_as(self, path: Path) -> Path | None:
        """The input that is the same file as an existing one: by name, symbolic link or hard link."""
        status, files = path.stat(), [*self.files]
        if status.st_nlink > 1:
            files += [file for folder in self.folders for file in folder.rglob("*") if file.is_file()]
        for file in files:
            if os.path.samestat(file.stat(), status):
                return file
        return next((folder for folder in self.folders if _is_within(path, folder)), None)


def require_file(
    option: str, path: Path | None, inputs: ReadFiles, *, kind: str, is_of_kind: Callable[[bytes], bool]
) -> None:
    """Raise OutputError where the file of an option, if it was given, must not or cannot be written.

    A file that begins as ``is_of_kind`` says may be replaced; ``kind`` says what that is, e.g. "a JSON file".
    """
    if path is None:
        return
    message = f"{option} names {path}, "
    if path.is_dir():
        raise OutputError(f"{message}which is a folder; name a file")
    if not path.parent.is_dir():
        what = "is a file" if path.parent.exists() else "does not exist"
        raise OutputError(f"{message}whose folder {what}; create the folder or correct the path")
    # A device or a pipe, e.g. /dev/stdout, is written into.
    if path.is_file():
        same = inputs.same_as(path)
        if same is not None:
            raise OutputError(f"{message}which would overwrite the input {same}; choose another name")
        if (reason := beside_that_keeps(path)) is not None:
            raise OutputError(f"{message}{reason}, or choose another name")
        with path.open("rb") as stream:
            head = stream.read(_HEAD_BYTES)
        if not is_of_kind(head):
            raise OutputError(f"{message}which exists and is not {kind}; remove it or choose another name")
        if not os.access(path, os.W_OK):
            raise OutputError(f"{message}which is write-protected; remove the protection or choose another name")
    elif not path.exists():
        _require_permission(message, path.parent)


def require_folder(option: str, path: Path | None, inputs: ReadFiles, *, may_hold_inputs: bool = False) -> None:
    """Raise OutputError where a folder cannot be made, or must not be written to.

    Folders in which the command replaces no file but its own may hold inputs.
    """
    if path is None:
        return
    message = f"{option} names {path}, "
    above = next(place for place in (path, *path.absolute().parents) if place.exists())
    if not above.is_dir():
        what = "which is a file" if above == path else f"but {above} is a file"
        raise OutputError(f"{message}{what}; name another folder")
    _require_permission(message, above)
    for folder in inputs.folders:
        if _is_within(path, folder):
            where = "whose files" if _is_within(folder, path) else f"which lies in {folder}, whose files"
            raise OutputError(f"{message}{where} are read; name a folder elsewhere")
    held = [place for place in (*inputs.files, *inputs.folders) if _is_within(place, path)]
    if held and not may_hold_inputs:
        raise OutputError(f"{message}which holds the input {held[0]}; move that, or name another folder")


def is_json(head: bytes) -> bool:
    """Whether a file that begins so is an object in JSON, or empty."""
    return head.lstrip()[:1] in (b"{", b"")


def is_png(head: bytes) -> bool:
    """Whether a file that begins so is a PNG, or empty."""
    return head[:4] in (b"\x89PNG", b"")


def _is_within(path: Path, folder: Path) -> bool:
    return path.resolve().is_relative_to(folder.resolve())


def _require_permission(message: str, folder: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{message}but {folder} is not writable; change its permissions or name another place")
    # Permission is not all: folders of the system, as those in /proc, take no file, nor does a full disk.
    try:
        TemporaryFile(dir=folder).close()
    except OSError as error:
        raise OutputError(f"{message}but {folder} takes no new file ({error.strerror}); name another place") from error


@contextmanager
def locked(folder: Path, *, busy: str) -> Iterator[None]:
    """Hold the lock of a folder, which exists, for a block; the system frees it when the process ends, however it ends.

    ``busy`` is the message where another process has the lock; ``{pid}`` in it is that process's number.
    """
    path, owner = folder / LOCK_FILE, folder / LOCK_OWNER
    lock = FileLock(path, blocking=False)
    try:
        lock.acquire()
    except Timeout as error:
        try:
            pid = owner.read_text(encoding="ascii").strip()
        except (OSError, ValueError):
            pid = ""
        raise SurveyError(busy.format(pid=pid or "unknown")) from error
    try:
        owner.write_text(str(os.getpid()), encoding="ascii")
        yield
    finally:
        owner.unlink(missing_ok=True)
        # Where an open file can be removed: who waits for it finds it removed, and makes it anew.
        with suppress(PermissionError):
            path.unlink(missing_ok=True)
        lock.release()
