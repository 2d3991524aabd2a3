"""Files that others bring: pipes and devices among them, those that are not read by their names, and large numbers."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from fnmatch import fnmatchcase
from pathlib import Path

from survey.errors import SurveyError

# No coordinate, time or number of a survey is larger; squares of larger ones overflow.
LARGEST = 1e12


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
