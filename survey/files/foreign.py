"""Files of other programs: those that are known by their names and not read, and the first sign of the others."""

from __future__ import annotations

from collections.abc import Mapping
from fnmatch import fnmatchcase
from pathlib import Path


def instead_of(path: Path, not_read: Mapping[str, str]) -> str | None:
    """What to do instead of giving a file or folder, by patterns of names in lower case; None for other names."""
    name = path.name.casefold()
    return next((instead for pattern, instead in not_read.items() if fnmatchcase(name, pattern)), None)


def begins_with(path: Path, sign: bytes) -> bool:
    """Whether a file begins with a sign, behind a byte order mark and blanks."""
    with path.open("rb") as file:
        return file.read(64).lstrip(b"\xef\xbb\xbf \t\r\n").startswith(sign)
