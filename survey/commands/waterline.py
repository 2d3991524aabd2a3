"""`bathynerf waterline`: the options and results of `survey.adjust.waterline`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.faults import require_address_space
from survey.commands.options import DeviceOption, Quiet, SurveyFolder, Verbose
from survey.words import Device

EXAMPLES = """
    bathynerf waterline my_survey
    bathynerf waterline my_survey --start-level 12.3
"""
_start = partial(typer.Option, rich_help_panel="Where it starts")


def run(
    survey: SurveyFolder,
    device: DeviceOption = Device.auto,
    nadir_only: Annotated[bool, _start("--nadir-only", help="Use only views that look straight down.")] = False,
    start_level: Annotated[float | None, _start(metavar="M", help="Start from this level [m].")] = None,
    start_index: Annotated[float | None, _start(metavar="N", help="Start from this refractive index.")] = None,
    poses_of: Annotated[Path | None, _start("--run", metavar="RUN", help="Use the poses computed by this run.")] = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON file for all results.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Estimate level, slopes and refractive index of the water from the photographs.

    The survey is not changed.
    """
    with command(verbose, quiet, json or survey, reads=survey) as results:
        require_address_space()
        from survey.adjust.waterline import estimate_water

        found = estimate_water(
            survey,
            device=device.value,
            nadir_only=nadir_only,
            start_level=start_level,
            start_index=start_index,
            run_folder=poses_of,
            json_path=json,
        )
        rows = [(estimate.name, estimate.verdict) for estimate in found.estimates]
        points = f"{found.num_points} in {found.num_views} views, {found.num_measurements} measurements"
        residuals = "none, nothing was adjusted" if found.rms_px is None else f"{found.rms_px:.3f} px rms"
        results.columns(None, [*rows, ("tie points", points), ("residuals", residuals)])
