"""`bathynerf change`: the options and results of `survey.change`."""

from __future__ import annotations

from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Annotated

import typer

from survey.change.options import ChangeOptions
from survey.commands.console import command
from survey.commands.options import Quiet, Verbose, grouped

EXAMPLES = """
    bathynerf change spring/bathynerf autumn/bathynerf
    bathynerf change a.las b.laz --area dredged.geojson
    bathynerf change a.las b.laz --stable banks.geojson
    bathynerf change a.las b.las --tif d.tif --picture d.png
    bathynerf change a.las b.las --json d.json
    bathynerf change a.las b.laz --std 0.05 --std-common 0
    bathynerf change 2024.las 2025.las 2026.las -o series
"""


@grouped
def run(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="Run folder, LAS, LAZ or COPC: the earliest survey.")],
    later: Annotated[list[Path], typer.Argument(metavar="RUN_B", help="Later surveys: one, or a series in time.")],
    asked: ChangeOptions = ChangeOptions(),
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", metavar="DIR", help="Folder for table and plot of a series."),
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute what changed between surveys: cut and fill, with their uncertainty.

    Volumes are of a later survey over the first, as they are, or after the
    later one is aligned in height on stable ground.
    """
    first_file = asked.json_path or asked.tif_path or asked.picture_path or output
    with command(verbose, quiet, first_file or run_a, reads=run_a) as results:
        from survey.change.change import change_between, rows_of
        from survey.change.series import change_series, rows_of_series

        if len(later) == 1 and output is None:
            results.columns(None, rows_of(change_between(run_a, later[0], asked)))
            return
        for area, epochs in groupby(change_series([run_a, *later], output, asked), attrgetter("area")):
            results.columns(area, rows_of_series(list(epochs)))
