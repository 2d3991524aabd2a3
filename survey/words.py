"""Words offered for a run, names of folders and files that parts of survey agree on, and texts as they are shown.

Texts of files, as names and settings are, are escaped for where they are shown: terminal, log, Markdown, figures.
"""

import re
import shutil
import textwrap
import unicodedata
from enum import StrEnum
from typing import IO

from fields.models import IN_LAYER

# Panels of help that several verbs have.
FILES, COMPARED = "Files of results", "What is compared"
# The run folder in a survey folder, where no other is named.
RUN_FOLDER = "bathynerf"
# In a run folder: what structure from motion keeps.
SFM_FOLDER = "sfm"
# Positions of photographs, as OpenDroneMap has them.
GEO_TXT = "geo.txt"
# Where OpenDroneMap looks for control points.
GCP_LIST = "gcp_list.txt"


class Quality(StrEnum):
    """Qualities, by run time; `survey.plan.choices` defines them."""

    draft = "draft"
    standard = "standard"
    fine = "fine"


class Device(StrEnum):
    """Devices of the kernels."""

    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


# Refinement of the heights of the sweep: as the plan decides, least squares, with boxes, nothing, or a trained field.
FIELDS = ("auto", "solver", "boxes", "off", *IN_LAYER)
# Words that were offered once, and those that took their place.
REPLACED = {"slab": "mdw"}


def instead_of_word(word: object) -> str:
    """The end of an error about an unknown word: the one that took its place, if there is one."""
    return f"; {REPLACED[word]} has taken the place of {word}" if isinstance(word, str) and word in REPLACED else ""


class Poses(StrEnum):
    """Treatment of the poses: as the plan decides, taken as they are, or adjusted."""

    auto = "auto"
    fixed = "fixed"
    refine = "refine"


class Drop(StrEnum):
    """Methods by which the submodules are found that a view leaves out."""

    geometry = "geometry"
    network = "network"
    none = "none"


# No coordinate, time or number of a survey is larger; squares of larger ones overflow.
LARGEST = 1e12
# Of photographs: each is half of the one before.
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)


# Columns that a text has at least, however narrow the terminal is.
_LEAST_COLUMNS = 20


def wrap_for(text: str, stream: IO[str], *, label: str = "", indent: str = "  ") -> str:
    """Text behind its label, wrapped to the width of a terminal, further lines indented; as it is for other streams."""
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


# Characters of a text that are shown at most, and of one word in it: names of files have 255 bytes, paths 4096.
MOST_CHARACTERS, _MOST_IN_WORD = 8000, 1000
_LONG_WORD = re.compile(rf"\S{{{_MOST_IN_WORD + 1},}}")
# Other spaces than " " are no control characters, though they do not count as printable.
_SPACE = "Zs"


def printable(text: str, most: int | None = MOST_CHARACTERS) -> str:
    """A text in one line that no terminal obeys: control, direction and line characters as escapes (``\\x1b``).

    Of a text with more than ``most`` characters start and end are kept; words are shortened likewise.
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
