"""Arguments and options that several verbs share."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from survey.words import Device, Field, Plan, Poses


def words_of(kind: Iterable[StrEnum]) -> str:
    """The words of an enumeration as a placeholder, e.g. auto|cpu|cuda."""
    return "|".join(kind)


# After Ctrl-C, for verbs that resume.
KEPT = "finished work is kept, and the same command resumes from there"

# Panels of help that several verbs have.
AIM, HOW, FILES = "How well, or how fast", "How it is computed", "Files of results"
COMPARED = "What is compared"

SurveyFolder = Annotated[Path, typer.Argument(metavar="SURVEY", help="Folder with images and survey.toml.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder written by process.")]
DeviceOption = Annotated[Device, typer.Option(metavar=words_of(Device), help="Where to compute.", rich_help_panel=HOW)]
AskedDevice = Annotated[
    Device | None,
    typer.Option(metavar=words_of(Device), help="Where to compute; default: auto.", rich_help_panel=HOW),
]
AskedField = Annotated[
    Field | None,
    typer.Option(
        metavar=words_of(Field),
        help="What refines the heights; slab: for render --field; default: auto.",
        rich_help_panel=HOW,
    ),
]
AskedPoses = Annotated[
    Poses | None,
    typer.Option(
        metavar=words_of(Poses),
        help="Adjust poses, lens and water together, or take the poses as they are; default: auto.",
        rich_help_panel=HOW,
    ),
]
AskedPlan = Annotated[
    Plan | None,
    typer.Option(
        metavar=words_of(Plan),
        help="Leave out what the scene does not need, or nothing; default: auto.",
        rich_help_panel=HOW,
    ),
]
TargetStd = Annotated[
    float | None,
    typer.Option(
        metavar="METRES",
        help="Standard deviation wanted on 95 % of the ground: the least work for it.",
        rich_help_panel=AIM,
    ),
]
TimeBudget = Annotated[
    float | None,
    typer.Option(metavar="SECONDS", help="What the run may take: the best that fits.", rich_help_panel=AIM),
]
ImageScale = Annotated[
    float | None,
    typer.Option(
        metavar="SCALE",
        help="Work on images at 1, 0.5, 0.25, ...; default: by size and quality.",
        rich_help_panel=HOW,
    ),
]
Visible = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Points of the reference that cameras see.", rich_help_panel=COMPARED),
]
Verbose = Annotated[
    int, typer.Option("-v", "--verbose", count=True, show_default=False, help="More details, and tracebacks.")
]
Quiet = Annotated[
    int, typer.Option("-q", "--quiet", count=True, show_default=False, help="Results without progress; -qq: no output.")
]
