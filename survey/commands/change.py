"""`bathynerf change`: the options and results of `survey.change`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from survey.commands.console import command
from survey.commands.options import Quiet, Verbose, grouped
from survey.words import FILES

EXAMPLES = """
    bathynerf change spring/bathynerf autumn/bathynerf
    bathynerf change a.las b.laz --area dredged.geojson
    bathynerf change a.las b.laz --stable banks.geojson
    bathynerf change a.las b.las --tif d.tif --picture d.png
    bathynerf change a.las b.las --json d.json
    bathynerf change a.las b.laz --std 0.05 --std-common 0
"""

_where = partial(typer.Option, rich_help_panel="Where")
_uncertainty = partial(typer.Option, rich_help_panel="Uncertainty")
_written = partial(typer.Option, rich_help_panel=FILES)


@dataclass(frozen=True)
class GroundOptions:
    """Options of the ground and its cells."""

    area: Annotated[Path | None, _where(metavar="FILE", help="Polygons in a vector file; default: all in common.")] = (
        None
    )
    stable: Annotated[
        Path | None,
        _where(metavar="FILE", help="Polygons of unchanged ground, to which the later survey is aligned in height."),
    ] = None
    resolution: Annotated[
        float | None, _where(metavar="M", help="Side of a cell [m]; default: by the spacing of the points.")
    ] = None


@dataclass(frozen=True)
class StdOptions:
    """Options of the standard deviations and their correlations."""

    correlation_length: Annotated[
        float | None, _uncertainty(metavar="M", help="Correlation length of errors [m]; default: measured.")
    ] = None
    common_correlation: Annotated[
        float,
        _uncertainty(
            metavar="R", help="Correlation of the two std_common: 0 independent, 1 with shared level and control."
        ),
    ] = 0.0
    std: Annotated[float | None, _uncertainty(metavar="M", help="std of heights, for clouds without one [m].")] = None
    std_common: Annotated[
        float | None,
        _uncertainty(metavar="M", help="std common to all heights, for clouds without std_common [m]."),
    ] = None


@grouped
def run(
    run_a: Annotated[Path, typer.Argument(metavar="RUN_A", help="Run folder, LAS, LAZ or COPC: the earlier survey.")],
    run_b: Annotated[Path, typer.Argument(metavar="RUN_B", help="The later survey.")],
    ground: GroundOptions = GroundOptions(),
    uncertainty: StdOptions = StdOptions(),
    json: Annotated[Path | None, _written(metavar="FILE", help="JSON file for the numbers.")] = None,
    tif: Annotated[Path | None, _written(metavar="FILE", help="GeoTIFF of differences and detection.")] = None,
    picture: Annotated[Path | None, _written(metavar="FILE", help="PNG of the differences.")] = None,
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
            area=ground.area,
            stable=ground.stable,
            resolution_m=ground.resolution,
            correlation_length_m=uncertainty.correlation_length,
            shared=uncertainty.common_correlation,
            stated=StatedStd(uncertainty.std, uncertainty.std_common),
            json_path=json,
            tif_path=tif,
            picture_path=picture,
        )
        results.columns(None, rows_of(change_between(run_a, run_b, options)))
