"""`bathynerf process`: the options of `survey.run.process`."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.faults import require_address_space
from survey.commands.options import KEPT, Quiet, Verbose, Visible, asking, grouped
from survey.init.options import InitOptions
from survey.settings.tables import ProcessConfig
from survey.words import COMPARED, RUN_FOLDER

EXAMPLES = """
    bathynerf process my_survey
    bathynerf process photographs --level 12.34
    bathynerf process my_survey -o draft --quality draft
    bathynerf process my_survey --target-std 0.02
    bathynerf process my_survey --time-budget 300
    bathynerf process my_survey --reference lidar.las
"""


@grouped
def run(
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
    visible: Visible = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute the point cloud of the bed and a report in a run folder, from photographs.

    Where there is no survey.toml, it is written first, as by init: with what no file states from options, or asked for
    on a terminal, and a comment at each value that is assumed.

    Options that are not given come from [process] in survey.toml, then the defaults.
    """
    from survey.files.remote import is_url, local_run

    folder = local_run(survey, output)
    with command(verbose, quiet, folder, stopped=KEPT, reads=survey) as results:
        require_address_space()
        from survey.init.draft import require_settings

        written = require_settings(survey, asking(told, needs_level=True))
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
