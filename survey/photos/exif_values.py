"""Values of EXIF as cameras and programs write them: texts and their padding, several values in place of one."""

from __future__ import annotations

from typing import Any

_LONGEST_WORDS = 60


def first(value: Any) -> Any:
    """The first of several values, which some programs write where the standard has one."""
    return value[0] if isinstance(value, tuple | list) and value else value


def plain(value: Any) -> str:
    """A text of EXIF without its padding."""
    text = value.decode("ascii", errors="replace") if isinstance(value, bytes) else str("" if value is None else value)
    return text.strip("\0 ")


def words(value: Any) -> str:
    """A text of EXIF for messages: without what a terminal obeys, and not longer than a line."""
    text = str(value)[:_LONGEST_WORDS]
    return "".join(letter for letter in text if letter.isprintable()).strip()
