"""`bathynerf check`: prints the findings of `survey.plan.check`."""

from __future__ import annotations

from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.memory import address_space_shortage
from survey.commands.options import Quiet, SurveyFolder, Verbose
from survey.plan.choices import Device, Quality

EXAMPLES = """
    bathynerf check my_survey
    bathynerf check my_survey --quality fine
"""


def run(
    survey: SurveyFolder,
    quality: Annotated[Quality, typer.Option(help="Plan for this quality.")] = Quality.standard,
    device: Annotated[Device, typer.Option(help="Plan for this device.")] = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Report what a survey has, what it lacks, and what process would do.

    Nothing is computed and nothing is written.
    """
    with command(verbose, quiet, survey) as results:
        from survey.plan.check import check_survey
        from survey.progress import current

        shortage = address_space_shortage()
        if shortage is not None:
            current().warn(shortage)
        for section in check_survey(survey, quality=quality.value, device=device.value):
            rows = [(f"  {label}" if label else "  -", text) for label, text in section.rows]
            results.columns(section.title, rows)
