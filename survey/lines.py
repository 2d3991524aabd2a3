"""Line breaks of output: between words on a terminal, none elsewhere."""

from __future__ import annotations

import shutil
import textwrap
from typing import IO

# Columns that a text has at least, however narrow the terminal is.
_LEAST_COLUMNS = 20


def fitted(text: str, stream: IO[str], *, label: str = "", indent: str = "  ") -> str:
    """A line after its label as a stream takes it; a terminal would break it in the middle of words.

    Parameters
    ----------
    stream : text file
        Only a terminal has a width.
    label : str
        What stands before the text.
    indent : str
        What stands before the lines that follow.
    """
    if not stream.isatty():
        return f"{label}{text}"
    width = max(shutil.get_terminal_size().columns, len(indent) + _LEAST_COLUMNS)
    return textwrap.fill(
        text,
        width,
        initial_indent=label,
        subsequent_indent=indent,
        break_long_words=False,
        break_on_hyphens=False,
        replace_whitespace=False,
        drop_whitespace=True,
    )
