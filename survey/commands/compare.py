"""`bathynerf compare`: the options and results of `survey.compare`."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import COMPARED, FILES, Quiet, Verbose, Visible, grouped, words_of

EXAMPLES = """
    bathynerf compare cloud.las reference.ply
    bathynerf compare cloud.las lidar.laz --json out.json
    bathynerf compare cloud.las lidar.laz --tolerance 0.1 \\
        --bounds 500000 5200000 500100 5200100
"""
_measured = partial(typer.Option, rich_help_panel="What is measured")
_compared = partial(typer.Option, rich_help_panel=COMPARED)
_written = partial(typer.Option, rich_help_panel=FILES)


class Sign(StrEnum):
    """Side of a triangle that counts as positive."""

    up = "up"
    winding = "winding"


@dataclass(frozen=True)
class FigureOptions:
    """Options of the figures."""

    tolerance: Annotated[
        list[float],
        _measured(metavar="M", help="For completeness and F-score [m]; repeatable."),
    ] = field(default_factory=lambda: [0.2])
    sign: Annotated[
        Sign,
        _measured(metavar=words_of(Sign), help="Positive above, or on the front of a face by its winding."),
    ] = Sign.up
    checkpoints: Annotated[
        Path | None, _measured(metavar="CSV", help="Check points: easting, northing, height and, if known, sigma.")
    ] = None
    c2c: Annotated[bool, _measured("--c2c", help="Also cloud-to-cloud distances, both ways.")] = False
    m3c2: Annotated[
        float | None, _measured(metavar="RADIUS", help="Also M3C2 distances, with this cylinder radius [m].")
    ] = None


@dataclass(frozen=True)
class PointOptions:
    """Options of the points that take part."""

    visible: Visible = None
    bounds: Annotated[
        tuple[float, float, float, float] | None,
        _compared(metavar="E0 N0 E1 N1", help="Crop the cloud to these bounds."),
    ] = None
    water_level: Annotated[
        float | None, _compared(metavar="HEIGHT", help="Water level in the CRS; default: that of the cloud.")
    ] = None
    outliers: Annotated[
        str | None, _compared(metavar="sor:K,S", help="Remove statistical outliers; default: keep all.")
    ] = None


@grouped
def run(
    cloud: Annotated[Path, typer.Argument(metavar="CLOUD", help="LAS, LAZ, COPC, PLY or E57.")],
    reference: Annotated[
        Path,
        typer.Argument(metavar="REFERENCE", help="PLY, OBJ, GLB, GeoTIFF, or points like CLOUD, also CSV and XYZ."),
    ],
    measured: FigureOptions = FigureOptions(),
    compared: PointOptions = PointOptions(),
    json: Annotated[Path | None, _written(metavar="FILE", help="JSON file for the numbers.")] = None,
    report: Annotated[Path | None, _written(metavar="DIR", help="Folder for pictures.")] = None,
    verbose: Verbose = 0,
    quiet: Quiet = 0,
) -> None:
    """Compare a cloud with a reference: signed distances, completeness, F-score.

    The cloud is not aligned to the reference first.
    """
    with command(verbose, quiet, report or json or cloud, reads=cloud) as results:
        from survey.compare.comparison import CompareOptions, compare_files
        from survey.compare.tables import sections_of

        options = CompareOptions(
            tolerances_m=tuple(measured.tolerance),
            visible=compared.visible,
            bounds=compared.bounds,
            sign=measured.sign.value,
            water_level=compared.water_level,
            checkpoints=measured.checkpoints,
            outliers=compared.outliers,
            c2c=measured.c2c,
            m3c2_radius_m=measured.m3c2,
            json_path=json,
            report_dir=report,
        )
        for section in sections_of(compare_files(cloud, reference, options=options)):
            results.section(section)
