"""Texts of files, as names and settings are, escaped for where they are shown: terminal, log, Markdown, figures."""

from __future__ import annotations

import re
import unicodedata

# Characters of a text that are shown at most, and of one word in it: names of files have 255 bytes, paths 4096.
MOST_CHARACTERS, _MOST_IN_WORD = 8000, 1000
_LONG_WORD = re.compile(rf"\S{{{_MOST_IN_WORD + 1},}}")
# Other spaces than " " are no control characters, though they do not count as printable.
_SPACE = "Zs"


def printable(text: str, most: int | None = MOST_CHARACTERS) -> str:
    """A text in one line that no terminal obeys: control, direction and line characters as escapes (``\\x1b``).

    Parameters
    ----------
    most : int, optional
        Characters that are kept of a longer text, from its start and its end; words are shortened likewise.
    """
    if most is not None:
        text = _shortened(_LONG_WORD.sub(lambda word: _shortened(word[0], _MOST_IN_WORD), text), most)
    if text.isprintable():
        return text
    return "".join(
        each if each.isprintable() or unicodedata.category(each) == _SPACE else each.encode("unicode_escape").decode()
        for each in text
    )


def _shortened(text: str, most: int) -> str:
    if len(text) <= most:
        return text
    start, end = most * 3 // 5, most * 3 // 10
    return f"{text[:start]}... ({len(text) - start - end} characters) ...{text[-end:]}"


def figure_text(text: str) -> str:
    """A text that matplotlib draws as it is, dollars of its mathematical expressions included."""
    return printable(text).replace("$", r"\$")


def markdown(text: str) -> str:
    """A text that Markdown shows as it is: each character that could be markup, or part of HTML, as a reference.

    Other than backslashes references also hold in tables, at starts of lines and before what makes web addresses links.
    """
    return "".join(
        each if each.isalnum() or each == " " or not each.isascii() else f"&#{ord(each)};" for each in printable(text)
    )
