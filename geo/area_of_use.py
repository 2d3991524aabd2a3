"""Areas of use: whether places lie in that of their CRS, and the national height systems of a place."""

from __future__ import annotations

from functools import cache

import numpy as np
from pyproj import CRS
from pyproj.aoi import AreaOfInterest
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import ProjError
from pyproj.transformer import AreaOfInterest as OperationArea

from geo.crs import AREA_MARGIN_DEG, degrees_outside_area, horizontal_crs, prime_meridian_rad
from geo.errors import PlaceMismatch
from geo.operations import operations
from geo.transformation import middle_of

# Areas wider than this are worldwide: mean sea level and its models, tides.
_WORLDWIDE_DEG = 350.0
_MARGIN_DEG = 0.01


def require_in_area(crs: CRS, points: np.ndarray, said: str, where: str = "crs") -> None:
    """Raise PlaceMismatch where the middle of points (N, 2 or 3) lies far outside the area that their CRS is made for.

    ``said`` and ``where`` are what the error names, and what is to be corrected.

    Raises
    ------
    PlaceMismatch
    """
    middle = middle_of(horizontal_crs(crs), np.asarray(points, dtype=np.float64))
    if middle is not None:
        _require_in_area(crs, np.radians(middle), said, where)


def require_at(crs: CRS, lon_lat_deg: np.ndarray, said: str, where: str) -> None:
    """Raise PlaceMismatch as `require_in_area`, for longitudes and latitudes (N, 2) of WGS 84 [deg]."""
    if len(lon_lat_deg):
        east, north = np.median(lon_lat_deg, axis=0).tolist()
        lon, lat = np.radians([east, north])
        said += f" (about {north:.3f} north, {east:.3f} east)"
        _require_in_area(crs, np.array([lon - prime_meridian_rad(crs), lat]), said, where)


def _require_in_area(crs: CRS, middle: np.ndarray, said: str, where: str) -> None:
    lon, lat = middle.tolist()
    excess = degrees_outside_area(crs, lon, lat)
    if excess > AREA_MARGIN_DEG:
        raise PlaceMismatch(
            f"{said} lie {excess:.0f} degrees outside the area that {crs.name} is made for; choose the CRS of the "
            f"place ({where})"
        )


@cache
def height_systems_at(lat_deg: float, lon_deg: float) -> tuple[CRS, ...]:
    """National vertical CRSs in metres at a place, the smallest area of use first.

    Only those whose geoid PROJ knows (its grid need not be installed), and of each area the newest (the highest EPSG
    code): systems that were replaced keep their areas. PROJ has areas as rectangles, so near a border those of the
    neighbours are among them, and only a single one is certain.
    """
    margin = _MARGIN_DEG
    box = lon_deg - margin, lat_deg - margin, lon_deg + margin, lat_deg + margin
    newest: dict[tuple[float, ...], tuple[float, int]] = {}
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS, AreaOfInterest(*box), contains=True):
        use, code = info.area_of_use, int(info.code)
        width = _WORLDWIDE_DEG if use is None else (use.east - use.west) % 360.0 or 360.0
        if use is None or width >= _WORLDWIDE_DEG or not _is_national(code, OperationArea(*box)):
            continue
        newest[use.bounds] = max(newest.get(use.bounds, (0.0, 0)), (width * (use.north - use.south), code))
    # By its code: two areas may be equally large.
    return tuple(CRS.from_epsg(code) for _, code in sorted(newest.values()))


def _is_national(code: int, area: OperationArea) -> bool:
    """Whether a vertical CRS counts metres upwards from a geoid that PROJ knows at the place."""
    vertical = CRS.from_epsg(code)
    axis = vertical.axis_info[0]
    if axis.direction != "up" or axis.unit_conversion_factor != 1.0:
        return False
    compound = CompoundCRS(f"WGS 84 + {vertical.name}", ["EPSG:4326", vertical])
    try:
        group = operations("EPSG:4979", compound, area)
    except ProjError:
        return False
    steps = [transformer.definition for transformer in group.transformers]
    steps += [operation.to_proj4() for operation in group.unavailable_operations]
    return any("vgridshift" in text for text in steps)
