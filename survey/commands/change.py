"""`bathynerf change`: the options and results of `survey.change`."""

from __future__ import annotations

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
"""


@grouped
def run(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="Run folder, LAS, LAZ or COPC: the earlier survey.")],
    run_b: Annotated[Path, typer.Argument(metavar="RUN_B", help="The later survey.")],
    asked: ChangeOptions = ChangeOptions(),
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute what changed between two surveys: cut and fill, with their uncertainty.

    Volumes are of the second survey over the first, as they are, or after the
    later one is aligned in height on stable ground.
    """
    first_file = asked.json_path or asked.tif_path or asked.picture_path
    with command(verbose, quiet, first_file or run_a, reads=run_a) as results:
        from survey.change.change import change_between, rows_of

        results.columns(None, rows_of(change_between(run_a, run_b, asked)))
