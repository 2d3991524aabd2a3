"""`bathynerf field`: the options of `survey.volume.field`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import DeviceOption, Quiet, RunFolder, Verbose, grouped
from survey.settings.tables import FieldConfig
from survey.words import Device

EXAMPLES = """
    bathynerf field my_survey/bathynerf --model mdw -o mdw
    bathynerf field my_survey/bathynerf --model tensorf \\
        -o t --held-every 8 --reference lidar.ply
    bathynerf field my_survey/bathynerf -o mdw \\
        --cameras cameras.csv
"""


@grouped
def run(
    run: RunFolder,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="New folder, or that of this training to resume.")
    ],
    asked: FieldConfig = FieldConfig(),
    device: DeviceOption = Device.auto,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Train a published radiance field on a run: surface, views and figures.

    Rays are bent at the water before the field is sampled. The same command resumes a stopped training. Options that
    are not given come from [field] in survey.toml, then the defaults.
    """
    with command(verbose, quiet, output, reads=run) as results:
        from survey.volume.field import rows_of, train_field
        from survey.volume.options import field_config, volume_options

        if asked.monocular is not None:
            asked = replace(asked, monocular=str(Path(asked.monocular).absolute()))
        options = volume_options(asked.over(field_config(run, asked.survey)), device=device.value)
        results.columns(None, rows_of(train_field(run, output, options), output))
