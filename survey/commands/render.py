"""`bathynerf render`: the options of `survey.export.render`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import DeviceOption, Quiet, RunFolder, Verbose
from survey.words import Device

_shown = partial(typer.Option, rich_help_panel="What is shown")
EXAMPLES = """
    bathynerf render my_survey/bathynerf -o pictures --dry \\
        --cameras my_survey/cameras.csv
    bathynerf render mdw -o pictures --cameras cameras.csv
"""


def run(
    run: RunFolder,
    cameras: Annotated[Path, typer.Option(metavar="FILE", help="Poses: a table like cameras.csv, or a COLMAP model.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="DIR", help="Folder for the pictures.")],
    dry: Annotated[bool, _shown("--dry", help="Remove the effect of the water.")] = False,
    field: Annotated[
        bool, _shown("--field", help="Render the field of `process --field mdw` instead of the photographs.")
    ] = False,
    video: Annotated[
        float | None,
        typer.Option(
            metavar="S", help="A video of a flight along the cameras in S seconds, flight.mp4.", min=0.1, max=3600
        ),
    ] = None,
    survey: Annotated[
        str | None, typer.Option(metavar="DIR", help="Survey folder, if it was moved since the run.")
    ] = None,
    device: DeviceOption = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Render the bed of a run, or a trained field, for other cameras: colours, heights, distances and normals.

    RUN may also be a folder of `bathynerf field`.
    """
    with command(verbose, quiet, output, reads=run) as results:
        from survey.export.render import render
        from survey.volume.folder import is_field

        if is_field(run):
            from survey.volume.stored import render_field

            pictures = render_field(run, cameras, output, dry=dry, device=device.value, video_s=video)
        else:
            pictures = render(
                run, cameras, output, dry=dry, trained=field, survey=survey, device=device.value, video_s=video
            )
        for path in pictures:
            results.line(path)
