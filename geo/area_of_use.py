"""Areas of use of CRSs, national height systems at a place, and the approximate geoid undulation there.

The undulation needs no grid to install. It serves to recognise which vertical datums were mixed up, where heights
differ by tens of metres; nothing is transformed with it. It is EGM96 (National Geospatial-Intelligence Agency, public
domain) at every fifth degree, in whole metres: interpolated, it is within 2 m (rms) of the model, and within 8 m over
99 % of the Earth.
"""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import Any, cast

import numpy as np
from pyproj import CRS, Geod
from pyproj.crs import CompoundCRS
from pyproj.database import query_crs_info
from pyproj.enums import PJType
from pyproj.exceptions import ProjError
from scipy.ndimage import map_coordinates

from geo.crs import (
    AREA_MARGIN_DEG,
    degrees_outside_area,
    geodetic_crs,
    horizontal_crs,
    middle_lon_lat,
    prime_meridian_rad,
)
from geo.errors import GeoError, PlaceMismatch
from geo.operations import area_about, operations
from geo.transformation import lon_lat, middle_of

# Areas wider than this are worldwide: mean sea level and its models, tides.
_WORLDWIDE_DEG = 350.0


def require_in_area(crs: CRS, points: np.ndarray, subject: str, where: str = "crs") -> None:
    """Raise PlaceMismatch where the middle of points (N, 2 or 3) lies far outside the area of use of their CRS.

    The error names ``subject`` as what lies outside, and ``where`` as what to correct.
    """
    middle = middle_of(horizontal_crs(crs), np.asarray(points, dtype=np.float64))
    if middle is not None:
        _require_in_area(crs, np.radians(middle), subject, where)


def require_at(crs: CRS, lon_lat_deg: np.ndarray, subject: str, where: str) -> None:
    """Raise PlaceMismatch as `require_in_area`, for longitudes and latitudes (N, 2) of WGS 84 [deg]."""
    if len(lon_lat_deg):
        east, north = middle_lon_lat(lon_lat_deg).tolist()
        lon, lat = np.radians([east, north])
        subject += f" (about latitude {north:.3f}, longitude {east:.3f})"
        _require_in_area(crs, np.array([lon - prime_meridian_rad(crs), lat]), subject, where)


def _require_in_area(crs: CRS, middle: np.ndarray, subject: str, where: str) -> None:
    lon, lat = middle.tolist()
    excess = degrees_outside_area(crs, lon, lat)
    if excess > AREA_MARGIN_DEG:
        raise PlaceMismatch(
            f"{subject} lie {excess:.0f} degrees outside the area that {crs.name} is made for; choose the CRS of the "
            f"place ({where})"
        )


@cache
def height_systems_at(lat_deg: float, lon_deg: float) -> tuple[CRS, ...]:
    """National vertical CRSs in metres at a place, the smallest area of use first.

    Only those whose geoid PROJ knows (its grid need not be installed), and of each area the newest (the highest EPSG
    code): systems that were replaced keep their areas. PROJ has areas as rectangles, so near a border those of the
    neighbours are among them, and only a single one is certain.
    """
    area: Any = area_about(lon_deg, lat_deg)  # The stubs of pyproj have two types for one class
    newest: dict[tuple[float, ...], tuple[float, int]] = {}
    for info in query_crs_info("EPSG", PJType.VERTICAL_CRS, area, contains=True):
        use, code = info.area_of_use, int(info.code)
        width = _WORLDWIDE_DEG if use is None else (use.east - use.west) % 360.0 or 360.0
        if use is None or width >= _WORLDWIDE_DEG or not _is_national(code, area):
            continue
        newest[use.bounds] = max(newest.get(use.bounds, (0.0, 0)), (width * (use.north - use.south), code))
    # The code decides between areas of equal size.
    return tuple(CRS.from_epsg(code) for _, code in sorted(newest.values()))


def likely_crs(points: np.ndarray, lon_lat_deg: tuple[float, float], within_m: float, like: CRS) -> list[CRS]:
    """Projected CRSs in use at a place in which points (N, 2 or 3) lie about it: the datum of ``like`` first.

    Codes that EPSG withdrew are left out; the median of the distances to the place is at most ``within_m``.
    """
    lon, lat = lon_lat_deg
    found, area = [], cast("Any", area_about(lon, lat))
    for info in query_crs_info("EPSG", PJType.PROJECTED_CRS, area, contains=True):
        crs = CRS.from_epsg(int(info.code))
        try:
            east, north = lon_lat(crs, points[:, :2]).T
        except (GeoError, ProjError):
            continue
        finite = np.isfinite(east) & np.isfinite(north) & (np.abs(north) <= 90.0)
        if not finite.any():
            continue
        places = np.broadcast_to([[lon], [lat]], (2, finite.sum()))
        away_m = float(np.median(Geod(ellps="WGS84").inv(east[finite], north[finite], *places)[2]))
        if away_m <= within_m:
            # Of a grid with its axes swapped, only the name differs here.
            is_other = geodetic_crs(crs) != geodetic_crs(like) or "(N-E)" in crs.name
            found.append((is_other, round(away_m, -2), int(info.code), crs))
    return [crs for *_, crs in sorted(found, key=lambda item: item[:3])]


def _is_national(code: int, area: Any) -> bool:
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


# Heights of the geoid (37, 72) [m], from 90 degrees south and 180 degrees west.
_GEOID, _STEP_DEG = "undulation.npy", 5.0


def approximate_undulation_m(lat_deg: float, lon_deg: float) -> float:
    """Approximate height of the geoid over the WGS 84 ellipsoid at a place [m]; negative where it lies below.

    Examples
    --------
    In Denmark about 40 m, and south of India, where it is lowest, -106 m.

    >>> round(approximate_undulation_m(55.0, 10.0)), round(approximate_undulation_m(5.0, 80.0))
    (40, -106)
    """
    with files("geo").joinpath(_GEOID).open("rb") as stream:
        grid = np.load(stream).astype(np.float64)
    at = [[(lat_deg + 90.0) / _STEP_DEG], [(lon_deg + 180.0) % 360.0 / _STEP_DEG]]
    # After the last meridian comes the first.
    return float(map_coordinates(np.column_stack([grid, grid[:, 0]]), at, order=1, mode="nearest")[0])
