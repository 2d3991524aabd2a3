"""Arguments and options that several verbs share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.plan.choices import Device

# Of Ctrl-C, for verbs that go on where they stopped.
KEPT = "what was finished is kept, and the same command goes on from there"

SurveyFolder = Annotated[Path, typer.Argument(metavar="SURVEY", help="Folder with images and survey.toml.")]
RunFolder = Annotated[Path, typer.Argument(metavar="RUN", help="Run folder that process made.")]
DeviceOption = Annotated[Device, typer.Option(help="Where it runs.")]
Verbose = Annotated[int, typer.Option("-v", "--verbose", count=True, show_default=False, help="More; tracebacks too.")]
Quiet = Annotated[
    int, typer.Option("-q", "--quiet", count=True, show_default=False, help="Results without progress; -qq: nothing.")
]
