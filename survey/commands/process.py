"""`bathynerf process`: the options of `survey.run.process`."""

from __future__ import annotations

from dataclasses import asdict
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
    AskedDevice,
    AskedField,
    AskedPlan,
    AskedPoses,
    ImageScale,
    Quiet,
    SurveyFolder,
    TargetStd,
    TimeBudget,
    Verbose,
    Visible,
    words_of,
)
from survey.names import RUN_FOLDER
from survey.words import Quality

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
    device: AskedDevice = None,
    field: AskedField = None,
    poses: AskedPoses = None,
    plan: AskedPlan = None,
    image_scale: ImageScale = None,
    resume: Annotated[bool, typer.Option(help="Reuse finished stages of an earlier run.")] = True,
    calibrate_water: Annotated[
        bool | None,
        typer.Option(help="First estimate the water from the photographs.", show_default=False, rich_help_panel=_WATER),
    ] = None,
    true_colour: Annotated[
        bool | None,
        typer.Option(
            help="Give points the colour of the bed without the water.", show_default=False, rich_help_panel=_WATER
        ),
    ] = None,
    tiles: Annotated[
        int | None,
        typer.Option(metavar="NUMBER", help="Tiles of the ground; default: by the memory.", rich_help_panel=HOW),
    ] = None,
    memory: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE", help="What the run may take, as 8GB; default: most of what is free.", rich_help_panel=HOW
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            metavar="NUMBER", help="Processes for tiles; default: by tiles, cores, memory.", rich_help_panel=HOW
        ),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Dask scheduler whose workers compute tiles.", rich_help_panel=HOW),
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="True surface, for the report only.", rich_help_panel=COMPARED)
    ] = None,
    visible: Visible = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute the point cloud of the bed and a report in a run folder.

    What no option says is what a variable of the environment says, e.g. BATHYNERF_PROCESS_QUALITY=fine, then [process]
    in survey.toml, then the default.
    """
    folder = output or survey / RUN_FOLDER
    with command(verbose, quiet, folder, stopped=KEPT) as results:
        require_address_space()
        from survey.commands.environment import asked_of_environment
        from survey.folder.config_process import ProcessConfig
        from survey.machine import process_age_s
        from survey.run.process import process

        asked = ProcessConfig(
            quality=quality,
            target_std_m=target_std,
            time_budget_s=time_budget,
            device=device,
            field=field,
            poses=poses,
            plan=plan,
            image_scale=image_scale,
            calibrate_water=calibrate_water,
            true_colour=true_colour,
            tiles=tiles,
            memory=memory,
            workers=workers,
            scheduler=scheduler,
        )
        code = process(
            survey,
            output,
            **asdict(asked.over(asked_of_environment())),
            time_gone_s=process_age_s(),
            resume=resume,
            reference=reference,
            visible=visible,
        )
        results.line(folder / "cloud.las")
        results.line(folder / "report.html")
        raise typer.Exit(code)
