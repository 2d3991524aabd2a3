"""Whether places lie in the area that a CRS is made for."""

from __future__ import annotations

import numpy as np
from pyproj import CRS

from geo.crs import AREA_MARGIN_DEG, degrees_outside_area, horizontal_crs, prime_meridian_rad
from geo.errors import PlaceMismatch
from geo.transformation import middle_of


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
    """As `require_in_area`, of longitudes and latitudes (N, 2) of WGS 84 [deg]."""
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
