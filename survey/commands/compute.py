"""The verbs that compute for long: process, waterline and field."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated

import typer

from survey.commands import console
from survey.settings.tables import FieldConfig, InitOptions, ProcessConfig
from survey.words import COMPARED, RUN_FOLDER, Device


@console.verb("""
    bathynerf process my_survey
    bathynerf process photographs --level 12.34
    bathynerf process my_survey -o draft --quality draft
    bathynerf process my_survey --target-std 0.02
    bathynerf process my_survey --time-budget 300
    bathynerf process my_survey --reference lidar.las
""")
def process(
    survey: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Photographs, in images/, DCIM/ or itself; survey.toml, if any.")
    ],
    output: Annotated[
        str | None,
        typer.Option("-o", "--output", metavar="RUN", help=f"Run folder, or a URL; default: SURVEY/{RUN_FOLDER}."),
    ] = None,
    told: InitOptions = InitOptions(),
    asked: ProcessConfig = ProcessConfig(),
    resume: Annotated[bool, typer.Option(help="Reuse finished stages of an earlier run.")] = True,
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="True surface, for the report only.", rich_help_panel=COMPARED)
    ] = None,
    visible: console.Visible = None,
    verbose: console.Verbose = 0,
    quiet: console.Quiet = 0,
) -> None:
    """Compute the point cloud of the bed and a report in a run folder, from photographs.

    Where there is no survey.toml, it is written first, as by init: with what no file states from options, or asked for
    on a terminal, and a comment at each value that is assumed.

    Options that are not given come from [process] in survey.toml, then the defaults.
    """
    from survey.files.remote import is_url, local_run

    folder = local_run(survey, output)
    with console.command(verbose, quiet, folder, stopped=console.KEPT, reads=survey) as results:
        from survey.init.draft import require_settings
        from survey.machine import require_memory

        require_memory()  # before survey.toml is written

        written = require_settings(survey, console.asking(told, needs_level=True))
        if written is not None:
            results.settings(written, hides=("#", "["))
        from survey.run.process import process

        code = process(
            survey,
            output if output is None or is_url(output) else Path(output),
            **asdict(asked),
            chooses_workers=True,
            resume=resume,
            reference=reference,
            visible=visible,
        )
        for name in ("cloud.las", "report.html"):
            results.line(f"{output.rstrip('/')}/{name}" if output and is_url(output) else folder / name)
        raise typer.Exit(code)


@console.verb("""
    bathynerf waterline my_survey
    bathynerf waterline my_survey --json water.json
""")
def waterline(
    survey: console.SurveyFolder,
    device: console.DeviceOption = Device.auto,
    poses_of: Annotated[
        Path | None, typer.Option("--run", metavar="RUN", help="Use the poses computed by this run.")
    ] = None,
    json: Annotated[Path | None, typer.Option(metavar="FILE", help="JSON file for all results.")] = None,
    verbose: console.Verbose = 0,
    quiet: console.Quiet = 0,
) -> None:
    """Estimate level, slopes and refractive index of the water from the photographs.

    The survey is not changed.
    """
    with console.command(verbose, quiet, json or survey, reads=survey) as results:
        from survey.adjust.waterline import estimate_water

        found = estimate_water(
            survey,
            device=device.value,
            run_folder=poses_of,
            json_path=json,
        )
        rows = [(estimate.name, estimate.verdict) for estimate in found.estimates]
        points = f"{found.num_points} in {found.num_views} views, {found.num_measurements} measurements"
        residuals = "none, nothing was adjusted" if found.rms_px is None else f"{found.rms_px:.3f} px rms"
        results.columns(None, [*rows, ("tie points", points), ("residuals", residuals)])


@console.verb("""
    bathynerf field my_survey/bathynerf --model mdw -o mdw
    bathynerf field my_survey/bathynerf --model tensorf \\
        -o t --held-every 8 --reference lidar.ply
    bathynerf field my_survey/bathynerf -o mdw \\
        --cameras cameras.csv
""")
def field(
    run: console.RunFolder,
    output: Annotated[
        Path, typer.Option("-o", "--output", metavar="DIR", help="New folder, or that of this training to resume.")
    ],
    asked: FieldConfig = FieldConfig(),
    device: console.DeviceOption = Device.auto,
    verbose: console.Verbose = 0,
    quiet: console.Quiet = 0,
) -> None:
    """Train a published radiance field on a run: surface, views and figures.

    Rays are bent at the water before the field is sampled. The same command resumes a stopped training. Options that
    are not given come from [field] in survey.toml, then the defaults.
    """
    with console.command(verbose, quiet, output, reads=run) as results:
        from survey.volume.field import rows_of, train_field
        from survey.volume.options import field_config, volume_options

        if asked.monocular is not None:
            asked = replace(asked, monocular=str(Path(asked.monocular).absolute()))
        options = volume_options(asked.over(field_config(run, asked.survey)), device=device.value)
        results.columns(None, rows_of(train_field(run, output, options), output))
