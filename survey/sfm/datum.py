"""Transformations of datums: what they add to the accuracy of positions, as PROJ states it, and grids of geoids.

An error of a transformation of datums is the same at all places of a survey. Where control holds the block it widens
the positions, and counts for nothing; else the whole block is shifted by it. A transformation that is worse than
the positions, for want of a grid, or because PROJ knows none, is refused where nothing else places the block.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS, CoordinateOperation
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest

from geo.crs import horizontal_crs, middle_lon_lat, vertical_crs
from geo.transformation import Transformation, area_about, operations
from survey.errors import FILE_NAME, ConfigError

# Positions that are better than this are those of a receiver with corrections, or of an adjusted block.
WELL_KNOWN_M = 0.1
# So many control points place a block.
_PLACING = 3
_GEOID_STEP = re.compile(r"\+proj=vgridshift\s+\+grids=(\S+)")


@dataclass(frozen=True)
class DatumStd:
    """Standard deviations [m] that a transformation of datums adds, alike at all places: in plan and in height."""

    plan: float = 0.0
    up: float = 0.0

    def onto(self, std: np.ndarray) -> np.ndarray:
        """Standard deviations (3,) [m] of a place after the transformation."""
        return np.hypot(std, [self.plan, self.plan, self.up])


EXACT = DatumStd()


def plan_std(transformation: Transformation) -> float:
    """Standard deviation [m] of places in plan by a transformation; 0 where PROJ does not know it."""
    return transformation.accuracy_m or 0.0


def require_accurate(transformation: Transformation, plan_std_m: float, positions: str, num_control: int) -> None:
    """Raise where a grid is missing, and the best transformation without it is worse than the positions, or not known.

    Parameters
    ----------
    plan_std_m : [m]
        Of the places in plan, before.
    positions : str
        What they are, e.g. "GPS positions".
    num_control : int
        Control points that place the block all the same.
    """
    if plan_std_m > WELL_KNOWN_M or num_control >= _PLACING:
        return
    transformation.require_known(
        positions, f"or give {_PLACING} control points or more in crs, which then place the block"
    )
    if not transformation.missing_grids:
        return
    if transformation.accuracy_m is not None and transformation.accuracy_m <= plan_std_m:
        return
    known = "an unknown accuracy" if transformation.accuracy_m is None else f"{transformation.accuracy_m:.2g} m"
    as_good = "taken as exact" if plan_std_m == 0.0 else f"good to {plan_std_m:.2g} m"
    transformation.require_best(
        f"{positions} are {as_good}, and the best transformation without a grid has {known}",
        f"or put it into the folder geoid of the survey; or give {_PLACING} control points or more in crs, which then "
        f"place the block, or position_std_m of {transformation.accuracy_m or 10.0:.2g} and more in [cameras] in "
        f"{FILE_NAME}: the survey may then be shifted by as much",
    )


def smallest(stds: Collection[DatumStd]) -> DatumStd:
    """Smallest of several values; nothing of none."""
    return DatumStd(*(min((getattr(each, name) for each in stds), default=0.0) for name in ("plan", "up")))


def area_at(lon: np.ndarray, lat: np.ndarray) -> AreaOfInterest:
    """Area of a survey, by longitudes and latitudes [deg], for PROJ to choose among regional transformations."""
    return area_about(*middle_lon_lat(np.column_stack([lon, lat])).tolist())


def height_transformer(crs: CRS, area: AreaOfInterest) -> Transformer:
    """Transformer from longitude, latitude [deg] and height above the WGS 84 ellipsoid [m] to the height in crs.

    Only heights are transformed: its horizontal part is WGS 84, so that no grid of horizontal datums is needed.
    """
    vertical = vertical_crs(crs)
    target = "EPSG:4979" if vertical is None else CompoundCRS(f"WGS 84 + {vertical.name}", ["EPSG:4326", vertical])
    message = f'gps_height = "ellipsoidal" needs a transformation of heights from the ellipsoid to {crs.name}'
    instead = f'or give heights in crs and gps_height = "crs" in {FILE_NAME}'
    try:
        group = operations("EPSG:4979", target, area)
    except ProjError as error:
        raise ConfigError(f"{message}, which PROJ does not know ({error}); {instead}") from error
    if group.transformers:
        return group.transformers[0]
    geodetic = horizontal_crs(crs).geodetic_crs
    grids = [] if geodetic is None else _geoid_grids(group.unavailable_operations, geodetic.name)
    if not grids:
        raise ConfigError(f"{message}, which PROJ does not have here; correct the vertical part of crs, {instead}")
    missing = f"the grid {grids[0]} is" if len(grids) == 1 else f"the grids {' and '.join(grids)} are"
    get = " and ".join(f"pyproj sync --file {name}" for name in grids)
    raise ConfigError(
        f"{message}, and {missing} not installed; install with {get}, put it into the folder geoid of the "
        f"survey, {instead}"
    )


def _geoid_grids(operations: list[CoordinateOperation], datum: str) -> list[str]:
    """Grids of the geoid that the best operation needs, among those that need no grid of horizontal datums.

    The best one belongs to the horizontal datum of the survey. A shift between horizontal datums by seven parameters
    belongs to older realisations than the one without.
    """
    ranked = []
    for operation in operations:
        steps = operation.to_proj4()
        grids, needed = _GEOID_STEP.findall(steps), list(operation.grids)
        if grids and len(grids) == len(needed):
            rank = (
                not all(grid.direct_download for grid in needed),
                datum not in operation.name,
                "+proj=helmert" in steps,
                operation.accuracy if operation.accuracy >= 0.0 else math.inf,
            )
            ranked.append((rank, grids))
    return min(ranked)[1] if ranked else []
