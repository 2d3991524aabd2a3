"""`bathynerf process`: the options of `survey.run.process`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.memory import require_address_space
from survey.commands.options import (
    AIM,
    COMPARED,
    HOW,
    KEPT,
    DeviceOption,
    ImageScale,
    Quiet,
    SurveyFolder,
    TargetStd,
    TimeBudget,
    Verbose,
    Visible,
    words_of,
)
from survey.machine import process_age_s
from survey.names import RUN_FOLDER
from survey.plan.choices import Device, Field, Plan, Poses, Quality

EXAMPLES = """
    bathynerf process my_survey
    bathynerf process my_survey -o draft --quality draft
    bathynerf process my_survey --target-std 0.02
    bathynerf process my_survey --time-budget 300
    bathynerf process my_survey --reference lidar.las
"""

_WATER = "Water"


def run(
    survey: SurveyFolder,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="RUN", help=f"Run folder; default: SURVEY/{RUN_FOLDER}.")
    ] = None,
    quality: Annotated[
        Quality | None,
        typer.Option(
            metavar=words_of(Quality),
            help="Trades run time for detail; default: standard.",
            show_default=False,
            rich_help_panel=AIM,
        ),
    ] = None,
    target_std: TargetStd = None,
    time_budget: TimeBudget = None,
    device: DeviceOption = Device.auto,
    field: Annotated[
        Field,
        typer.Option(
            metavar=words_of(Field), help="What refines the heights; slab: for render --field.", rich_help_panel=HOW
        ),
    ] = Field.auto,
    poses: Annotated[
        Poses,
        typer.Option(
            metavar=words_of(Poses),
            help="Adjust poses, lens and water together, or take the poses as they are.",
            rich_help_panel=HOW,
        ),
    ] = Poses.auto,
    plan: Annotated[
        Plan,
        typer.Option(
            metavar=words_of(Plan), help="Leave out what the scene does not need, or nothing.", rich_help_panel=HOW
        ),
    ] = Plan.auto,
    image_scale: ImageScale = None,
    resume: Annotated[bool, typer.Option(help="Reuse finished stages of an earlier run.")] = True,
    calibrate_water: Annotated[
        bool,
        typer.Option(
            "--calibrate-water", help="First estimate the water from the photographs.", rich_help_panel=_WATER
        ),
    ] = False,
    true_colour: Annotated[
        bool,
        typer.Option(
            "--true-colour", help="Give points the colour of the bed without the water.", rich_help_panel=_WATER
        ),
    ] = False,
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="True surface, for the report only.", rich_help_panel=COMPARED)
    ] = None,
    visible: Visible = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute the point cloud of the bed and a report in a run folder."""
    folder = output or survey / RUN_FOLDER
    with command(verbose, quiet, folder, stopped=KEPT) as results:
        require_address_space()
        from survey.run.process import process

        code = process(
            survey,
            output,
            quality=None if quality is None else quality.value,
            target_std_m=target_std,
            time_budget_s=time_budget,
            time_gone_s=process_age_s(),
            device=device.value,
            field=field.value,
            poses=poses.value,
            plan=plan.value,
            image_scale=image_scale,
            resume=resume,
            calibrate_water=calibrate_water,
            true_colour=true_colour,
            reference=reference,
            visible=visible,
        )
        results.line(folder / "cloud.las")
        results.line(folder / "report.html")
        raise typer.Exit(code)
