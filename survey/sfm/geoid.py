"""Ellipsoidal heights converted to a vertical datum by the grid of its geoid."""

from __future__ import annotations

import math
import re

import numpy as np
from pyproj import CRS, Transformer
from pyproj.crs import CompoundCRS, CoordinateOperation
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest

from geo.crs import horizontal_crs, vertical_crs
from geo.transformation import area_about, operations
from survey.errors import FILE_NAME, ConfigError

_GEOID_STEP = re.compile(r"\+proj=vgridshift\s+\+grids=(\S+)")


def area_at(lon: np.ndarray, lat: np.ndarray) -> AreaOfInterest:
    """Where a survey lies, by longitudes and latitudes [deg], for PROJ to choose among regional transformations."""
    return area_about(float(np.median(lon)), float(np.median(lat)))


def height_transformer(crs: CRS, area: AreaOfInterest) -> Transformer:
    """From longitude, latitude [deg] and height above the WGS 84 ellipsoid [m] to the height in crs.

    Only heights are transformed: its horizontal part is WGS 84, so that no grid of horizontal datums is needed.

    Raises
    ------
    ConfigError
        If PROJ does not know the vertical datum, or the grid of its geoid is not installed. Without the grid PROJ would
        hand heights through unchanged, tens of metres wrong, without a word.
    """
    vertical = vertical_crs(crs)
    target = "EPSG:4979" if vertical is None else CompoundCRS(f"WGS 84 + {vertical.name}", ["EPSG:4326", vertical])
    said = f'gps_height = "ellipsoidal" needs a transformation of heights from the ellipsoid to {crs.name}'
    instead = f'or give heights in crs and gps_height = "crs" in {FILE_NAME}'
    try:
        group = operations("EPSG:4979", target, area)
    except ProjError as error:
        raise ConfigError(f"{said}, which PROJ does not know ({error}); {instead}") from error
    if group.transformers:
        return group.transformers[0]
    geodetic = horizontal_crs(crs).geodetic_crs
    grids = [] if geodetic is None else _geoid_grids(group.unavailable_operations, geodetic.name)
    if not grids:
        raise ConfigError(
            f"{said}, which PROJ does not have for the place of these photographs; correct the vertical part of crs, "
            f"{instead}"
        )
    missing = f"the grid {grids[0]} is" if len(grids) == 1 else f"the grids {' and '.join(grids)} are"
    get = " and ".join(f"pyproj sync --file {name}" for name in grids)
    raise ConfigError(
        f"{said}, and {missing} not installed; install with {get}, put it into the folder geoid of the "
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
