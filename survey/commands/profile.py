"""`bathynerf profile`: the options and results of `survey.export.profiles`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose
from survey.words import FILES

EXAMPLES = """
    bathynerf profile RUN --lines sections.geojson
    bathynerf profile RUN --lines axis.dxf --dxf cut.dxf
    bathynerf profile bed.laz --lines sections.gpkg \\
        --reference lidar.laz --picture sections.png
"""


def run(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder, LAS, LAZ or COPC.")],
    lines: Annotated[
        Path,
        typer.Option(metavar="FILE", help="Lines as GeoJSON or (extra vector) GeoPackage, shapefile or DXF."),
    ],
    step: Annotated[
        float | None, typer.Option(metavar="M", help="Step along lines [m]; default: by the spacing of the points.")
    ] = None,
    reference: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Reference surface to plot: mesh, GeoTIFF or points.")
    ] = None,
    csv: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Table of all places.", rich_help_panel=FILES)
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="PNG of the profiles.", rich_help_panel=FILES)
    ] = None,
    dxf: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Bed, water and reference as lines in space.", rich_help_panel=FILES),
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Draw profiles of the bed along lines: bed, water, standard deviation, reference."""
    with command(verbose, quiet, csv or picture or dxf or run, reads=run) as results:
        from survey.export.profiles import profiles_along, subtitle_of

        found = profiles_along(
            run, lines, step_m=step, reference=reference, csv_path=csv, picture_path=picture, dxf_path=dxf
        )
        results.columns(None, [(profile.name, subtitle_of(profile)) for profile in found])
