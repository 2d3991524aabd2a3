"""`bathynerf compare`: the options and results of `survey.compare`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose, grouped
from survey.compare.options import CompareOptions

EXAMPLES = """
    bathynerf compare cloud.las reference.ply
    bathynerf compare cloud.las lidar.laz --json out.json
    bathynerf compare cloud.las lidar.laz --tolerance 0.1 \\
        --bounds 500000 5200000 500100 5200100
"""


@grouped
def run(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="Run folder, LAS, LAZ, COPC, PLY or E57.")],
    reference: Annotated[
        Path,
        typer.Argument(metavar="REFERENCE", help="PLY, OBJ, GLB, GeoTIFF, or points like CLOUD, also CSV and XYZ."),
    ],
    asked: CompareOptions = CompareOptions(),
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compare a cloud with a reference: signed distances, completeness, F-score.

    The cloud is not aligned to the reference first.
    """
    with command(verbose, quiet, asked.report_dir or asked.json_path or cloud, reads=cloud) as results:
        from survey.compare.comparison import compare_files
        from survey.compare.tables import sections_of
        from survey.export.export import cloud_of

        for section in sections_of(compare_files(cloud_of(cloud), reference, options=asked)):
            results.section(section)
