"""`bathynerf export`: the options of `survey.run.export`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, RunFolder, Verbose
from survey.errors import SurveyError

EXAMPLES = """
    bathynerf export my_survey/bathynerf --laz bed.laz
    bathynerf export my_run --las bed.las --ply bed.ply
"""


def run(
    run: RunFolder,
    las: Annotated[Path | None, typer.Option(metavar="FILE", help="LAS 1.4 file to write.")] = None,
    laz: Annotated[Path | None, typer.Option(metavar="FILE", help="LAZ file to write.")] = None,
    ply: Annotated[Path | None, typer.Option(metavar="FILE", help="PLY file to write.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Write the point cloud of a run in other formats."""
    with command(verbose, quiet, run) as results:
        if las is laz is ply is None:
            raise SurveyError("nothing to export was named; give at least one of --las F, --laz F, --ply F")
        from survey.run.export import export

        for path in export(run, las=las, laz=laz, ply=ply):
            results.line(path)
