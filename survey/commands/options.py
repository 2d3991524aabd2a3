"""Arguments and options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.plan.choices import Device

# After Ctrl-C, for verbs that resume.
KEPT = "finished work is kept, and the same command resumes from there"

SurveyFolder = Annotated[Path, typer.Argument(metavar="SURVEY", help="Folder with images and survey.toml.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder written by process.")]
DeviceOption = Annotated[Device, typer.Option(help="Where to compute.")]
TargetStd = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Standard deviation wanted on 95 % of the ground: the least work for it."),
]
TimeBudget = Annotated[float | None, typer.Option(metavar="SECONDS", help="What the run may take: the best that fits.")]
ImageScale = Annotated[
    float | None,
    typer.Option(metavar="SCALE", help="Work on images at 1, 0.5, 0.25, ...; default: by size and quality."),
]
Visible = Annotated[Path | None, typer.Option(metavar="FILE", help="Points of the reference that cameras see.")]
Verbose = Annotated[
    int, typer.Option("-v", "--verbose", count=True, show_default=False, help="More details, and tracebacks.")
]
Quiet = Annotated[
    int, typer.Option("-q", "--quiet", count=True, show_default=False, help="Results without progress; -qq: no output.")
]
