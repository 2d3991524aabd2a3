"""`bathynerf compare`: the options and results of `survey.compare`."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import COMPARED, FILES, Quiet, Verbose, Visible, words_of

EXAMPLES = """
    bathynerf compare cloud.las reference.ply
    bathynerf compare cloud.las lidar.laz --json out.json
    bathynerf compare cloud.las lidar.laz --tolerance 0.1 \\
        --bounds 500000 5200000 500100 5200100
"""
_TOLERANCES_M = [0.2]
_MEASURED = "What is measured"


class Sign(StrEnum):
    """Side of a triangle that counts as positive."""

    up = "up"
    winding = "winding"


def run(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="LAS, LAZ, COPC, PLY or E57.")],
    reference: Annotated[
        Path,
        typer.Argument(metavar="REFERENCE", help="PLY, OBJ, GLB, GeoTIFF, or points like CLOUD, also CSV and XYZ."),
    ],
    tolerance: Annotated[
        list[float],
        typer.Option(metavar="M", help="For completeness and F-score [m]; repeatable.", rich_help_panel=_MEASURED),
    ] = _TOLERANCES_M,
    visible: Visible = None,
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="E0 N0 E1 N1", help="Crop the cloud to these bounds.", rich_help_panel=COMPARED),
    ] = None,
    sign: Annotated[
        Sign,
        typer.Option(
            metavar=words_of(Sign),
            help="Positive above, or on the front of a face by its winding.",
            rich_help_panel=_MEASURED,
        ),
    ] = Sign.up,
    water_level: Annotated[
        float | None,
        typer.Option(
            metavar="HEIGHT", help="Water level in the CRS; default: that of the cloud.", rich_help_panel=COMPARED
        ),
    ] = None,
    checkpoints: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Check points: easting, northing, height and, if known, sigma.",
            rich_help_panel=_MEASURED,
        ),
    ] = None,
    outliers: Annotated[
        str | None,
        typer.Option(
            metavar="sor:K,S", help="Remove statistical outliers; default: keep all.", rich_help_panel=COMPARED
        ),
    ] = None,
    c2c: Annotated[
        bool, typer.Option("--c2c", help="Also cloud-to-cloud distances, both ways.", rich_help_panel=_MEASURED)
    ] = False,
    m3c2: Annotated[
        float | None,
        typer.Option(
            metavar="RADIUS", help="Also M3C2 distances, with this cylinder radius [m].", rich_help_panel=_MEASURED
        ),
    ] = None,
    json: Annotated[
        Path | None, typer.Option(metavar="FILE", help="JSON file for the numbers.", rich_help_panel=FILES)
    ] = None,
    report: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Folder for pictures.", rich_help_panel=FILES)
    ] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compare a cloud with a reference: signed distances, completeness, F-score.

    The cloud is not aligned to the reference first.
    """
    with command(verbose, quiet, report or json or cloud, reads=cloud) as results:
        from survey.compare.comparison import CompareOptions, compare_files
        from survey.compare.text import sections_of

        options = CompareOptions(
            tolerances_m=tuple(tolerance),
            visible=visible,
            bounds=bounds,
            sign=sign.value,
            water_level=water_level,
            checkpoints=checkpoints,
            outliers=outliers,
            c2c=c2c,
            m3c2_radius_m=m3c2,
            json_path=json,
            report_dir=report,
        )
        for title, rows in sections_of(compare_files(cloud, reference, options=options)):
            if title is not None:
                results.line("")
            results.columns(title, rows)
