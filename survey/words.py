"""Words offered for a run, names of folders and files that parts of survey agree on, and line breaks of output."""

from __future__ import annotations

import shutil
import textwrap
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


# Of photographs: each is half of the one before.
SCALES = (1.0, 0.5, 0.25, 0.125, 0.0625)


# Columns that a text has at least, however narrow the terminal is.
_LEAST_COLUMNS = 20


def wrap_for(text: str, stream: IO[str], *, label: str = "", indent: str = "  ") -> str:
    """Text behind its label, wrapped between words to the width of a terminal; as it is for other streams.

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
