"""Ellipsoid to Cartesian and back, in closed form.

| symbol | code | meaning |
|---|---|---|
| a, b | `a`, `b` | semi-axes of the ellipsoid [m] |
| e² | `1 - (b / a)²` | first eccentricity squared |
| φ, λ | `lat`, `lon` | geodetic latitude and longitude [rad] |
| β | `beta` | reduced latitude, tan β = (b / a) tan φ [rad] |
| N | `normal` | radius of curvature in the prime vertical [m] |
"""

from __future__ import annotations

import numpy as np

# Bowring's iteration gains about five digits a step below 10 km of height; three steps reach the last bit.
_BOWRING_STEPS = 3


def geocentric_from_geodetic(lon, lat, height, *, a: float, b: float) -> np.ndarray:
    """Geocentric x, y, z (..., 3) [m] of geodetic longitude, latitude [rad] and ellipsoidal height [m]."""
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    axis_ratio2 = (b / a) ** 2
    normal = a / np.sqrt(cos_lat**2 + axis_ratio2 * sin_lat**2)
    from_axis = (normal + height) * cos_lat
    z = (normal * axis_ratio2 + height) * sin_lat
    return np.stack(np.broadcast_arrays(from_axis * np.cos(lon), from_axis * np.sin(lon), z), axis=-1)


def geodetic_from_geocentric(xyz, *, a: float, b: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longitude, latitude [rad] and ellipsoidal height [m] of geocentric points (..., 3) [m].

    Exact to the rounding of the geocentric coordinates (1e-9 m) from the bottom of the sea to aircraft.

    Notes
    -----
    Bowring 1976, "Transformation from spatial to geographical coordinates", Survey Review 181. The height is
    ``p cos φ + z sin φ - a² / N``, which keeps its digits at the poles, where ``p / cos φ - N`` does not.
    """
    x, y, z = xyz[..., 0], xyz[..., 1], xyz[..., 2]
    p = np.hypot(x, y)
    e2 = 1.0 - (b / a) ** 2
    second_e2_b = (a**2 - b**2) / b
    beta = np.arctan2(a * z, b * p)
    for _ in range(_BOWRING_STEPS):
        lat = np.arctan2(z + second_e2_b * np.sin(beta) ** 3, p - e2 * a * np.cos(beta) ** 3)
        beta = np.arctan2(b * np.sin(lat), a * np.cos(lat))
    sin_lat = np.sin(lat)
    height = p * np.cos(lat) + z * sin_lat - a * np.sqrt(1.0 - e2 * sin_lat**2)
    return np.arctan2(y, x), lat, height


def enu_from_geocentric(lon, lat) -> np.ndarray:
    """Rotations (..., 3, 3) from geocentric axes to east, north and up at longitudes and latitudes (...) [rad]."""
    sl, cl, sp, cp = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    rows = [[-sl, cl, np.zeros_like(sl)], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
