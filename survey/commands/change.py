"""`bathynerf change`: the options and results of `survey.change`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import FILES, Quiet, Verbose

EXAMPLES = """
    bathynerf change spring/bathynerf autumn/bathynerf
    bathynerf change a.las b.laz --area dredged.geojson
    bathynerf change a.las b.laz --stable banks.geojson
    bathynerf change a.las b.las --tif d.tif --picture d.png
    bathynerf change a.las b.las --json d.json
    bathynerf change a.las b.laz --std 0.05 --std-common 0
"""

_STD = "Uncertainty"


def run(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="Run folder, LAS, LAZ or COPC: the earlier survey.")],
    run_b: Annotated[Path, typer.Argument(metavar="RUN_B", help="The later survey.")],
    area: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Polygons as GeoJSON or GeoPackage; default: all in common.", rich_help_panel="Where"
        ),
    ] = None,
    stable: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Polygons of unchanged ground, to which the later survey is aligned in height.",
            rich_help_panel="Where",
        ),
    ] = None,
    resolution: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="Side of a cell [m]; default: by the spacing of the points.", rich_help_panel="Where"
        ),
    ] = None,
    correlation_length: Annotated[
        float | None,
        typer.Option(metavar="M", help="Correlation length of errors [m]; default: measured.", rich_help_panel=_STD),
    ] = None,
    common_correlation: Annotated[
        float,
        typer.Option(
            metavar="R",
            help="Correlation of the two std_common: 0 independent, 1 with shared level and control.",
            rich_help_panel=_STD,
        ),
    ] = 0.0,
    std: Annotated[
        float | None,
        typer.Option(metavar="M", help="std of heights, for clouds without one [m].", rich_help_panel=_STD),
    ] = None,
    std_common: Annotated[
        float | None,
        typer.Option(
            metavar="M", help="std common to all heights, for clouds without std_common [m].", rich_help_panel=_STD
        ),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON file for the numbers.", rich_help_panel=FILES)
    ] = None,
    tif: Annotated[
        Path | None, typer.Option(metavar="FILE", help="GeoTIFF of differences and detection.", rich_help_panel=FILES)
    ] = None,
    picture: Annotated[
        Path | None, typer.Option(metavar="FILE", help="PNG of the differences.", rich_help_panel=FILES)
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compute what changed between two surveys: cut and fill, with their uncertainty.

    Volumes are of the second survey over the first, as they are, or after the
    later one is aligned in height on stable ground.
    """
    with command(verbose, quiet, json or tif or picture or run_a, reads=run_a) as results:
        from survey.change.change import ChangeOptions, change_between, rows_of
        from survey.change.differences import StatedStd

        options = ChangeOptions(
            area=area,
            stable=stable,
            resolution_m=resolution,
            correlation_length_m=correlation_length,
            shared=common_correlation,
            stated=StatedStd(std, std_common),
            json_path=json,
            tif_path=tif,
            picture_path=picture,
        )
        results.columns(None, rows_of(change_between(run_a, run_b, options)))
