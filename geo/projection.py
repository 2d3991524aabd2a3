"""Conversion between coordinates of a CRS, longitude, latitude and height on its own datum, and Cartesian ones.

Only the map projection and the units are undone and redone: the same datum on both sides, no grids, no geoid.

| symbol | code | meaning |
|---|---|---|
| a, b | `a`, `b` | semi-axes of the ellipsoid [m] |
| e² | `1 - (b / a)²` | first eccentricity squared |
| φ, λ | `lat`, `lon` | geodetic latitude and longitude [rad] |
| β | `beta` | reduced latitude, tan β = (b / a) tan φ [rad] |
| N | `normal` | radius of curvature in the prime vertical [m] |
"""

import numpy as np
from pyproj import CRS, Transformer
from pyproj.exceptions import ProjError

import geo.crs
from geo.errors import GeoError

# Bowring's iteration gains about five digits a step below 10 km of height; three steps reach the last bit.
_BOWRING_STEPS = 3
# Of the central differences of `metres_per_unit`: 64 m on the ground.
_STEP_RAD = 1e-5
# The scale of a grid made for surveying differs from 1 by less than this.
_TO_SCALE = 0.01


def geocentric_from_geodetic(lon, lat, height, *, a: float, b: float) -> np.ndarray:
    """Geocentric x, y, z (..., 3) [m] of geodetic longitude, latitude [rad] and ellipsoidal height [m]."""
    sin_lat, cos_lat = np.sin(lat), np.cos(lat)
    axis_ratio2 = (b / a) ** 2
    normal = a / np.sqrt(cos_lat**2 + axis_ratio2 * sin_lat**2)
    from_axis = (normal + height) * cos_lat
    z = (normal * axis_ratio2 + height) * sin_lat
    return np.stack(np.broadcast_arrays(from_axis * np.cos(lon), from_axis * np.sin(lon), z), axis=-1)


def geodetic_from_geocentric(xyz, *, a: float, b: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longitude, latitude [rad] and ellipsoidal height [m] of geocentric points (..., 3) [m], to 1e-9 m.

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


class MapProjection:
    """The map projection of a CRS with heights (`geo.crs.parse_crs`), in float64."""

    def __init__(self, crs: CRS):
        axes, horizontal = geo.crs.ellipsoid(crs), geo.crs.horizontal_crs(crs)
        self.a, self.b = axes.semi_major_metre, axes.semi_minor_metre  # [m]: semi-axes of the ellipsoid
        self.horizontal_unit = geo.crs.horizontal_unit(crs)  # [m] or [rad]: one unit of easting or of longitude
        self.height_unit_m = geo.crs.height_unit_m(crs)
        self.is_geographic = horizontal.is_geographic  # Whether horizontal coordinates are angles
        self._angle_unit = geo.crs.angular_unit_rad(crs)
        self._lonlat_from_grid: Transformer | None = None
        if not self.is_geographic:
            # The one place that fixes the order of axes: easting before northing, longitude before latitude.
            try:
                self._lonlat_from_grid = Transformer.from_crs(horizontal, geo.crs.geodetic_crs(crs), always_xy=True)
            except ProjError as error:
                raise GeoError(
                    f"{geo.crs.crs_name(crs)} has a map projection that PROJ cannot compute ({str(error)[:120]}); "
                    "give one of EPSG, e.g. EPSG:25832"
                ) from error

    def geodetic_from_crs(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Longitude (from the CRS's own prime meridian), latitude [rad] and height [m], each (...), of points (..., 3).

        NaN where a point is not finite or not on the map. PROJ inverts some projections (EPSG:3035, equal area) by a
        series that ends at 0.3 mm. One step of
        ``x + (x - forward(inverse(x)))`` brings all of them to the last digits of the forward projection.
        """
        x, y, height = np.moveaxis(nan_unless_finite(points), -1, 0)
        if self._lonlat_from_grid is not None:
            lon, lat = self._lonlat_from_grid.transform(x, y)
            again_x, again_y = self._lonlat_from_grid.transform(lon, lat, direction="INVERSE")
            x, y = self._lonlat_from_grid.transform(x + (x - again_x), y + (y - again_y))
        lonlat = nan_unless_finite(np.stack([x, y], axis=-1)) * self._angle_unit
        return lonlat[..., 0], lonlat[..., 1], height * self.height_unit_m

    def crs_from_geodetic(self, lon, lat, height) -> np.ndarray:
        """Points (..., 3) in crs of longitude, latitude [rad] and height [m]; NaN where one is not finite."""
        x, y = lon / self._angle_unit, lat / self._angle_unit
        if self._lonlat_from_grid is not None:
            x, y = self._lonlat_from_grid.transform(x, y, direction="INVERSE")
        return nan_unless_finite(np.stack([x, y, height / self.height_unit_m], axis=-1))


def metres_per_unit(crs: CRS, places: np.ndarray) -> np.ndarray:
    """Metres of ground (2,) in one unit of easting and of northing, or of longitude and latitude, on the ellipsoid.

    At the middle of places (N, 2 or 3) in a CRS with heights; NaN where there are none on the map.
    """
    middle = np.full(2, np.nan) if not len(places) else np.median(np.asarray(places, dtype=np.float64)[:, :2], axis=0)
    own = MapProjection(crs)
    step = _STEP_RAD if own.is_geographic else _STEP_RAD * own.a
    steps = step / own.horizontal_unit * np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    at = np.array([*middle, 0.0])
    ends = [
        geocentric_from_geodetic(*own.geodetic_from_crs(at + side * steps), a=own.a, b=own.b) for side in (-0.5, 0.5)
    ]
    return np.linalg.norm(ends[1] - ends[0], axis=-1) / steps[[0, 1], [0, 1]]


def ground_units_m(crs: CRS, place: np.ndarray) -> np.ndarray:
    """Metres per unit near a place (east, north, ...), of a cell, a map, a product.

    Grids for surveying (UTM, the Lambert grids of countries) keep within a hundredth of true lengths: one of their
    units is one unit on the ground. Degrees are shorter along parallels, and Web Mercator stretches the ground by 1.49
    at 48 degrees. Places are rounded to a hundredth of a degree, or a kilometre, so that neighbours agree.
    """
    unit = geo.crs.horizontal_unit(crs)
    rounded = np.radians(0.01) / unit if geo.crs.horizontal_crs(crs).is_geographic else 1000.0 / unit
    near = np.round(np.asarray(place, dtype=np.float64)[None, :2] / rounded) * rounded
    true = metres_per_unit(crs if geo.crs.has_height(crs) else crs.to_3d(), near)
    is_to_scale = (np.abs(true / unit - 1.0) <= _TO_SCALE).all() or not np.isfinite(true).all()
    return np.full(2, unit) if is_to_scale else true


def is_to_scale(crs: CRS, place: np.ndarray) -> bool:
    """Whether coordinates in crs are lengths on the ground, to a hundredth, near a place (east, north, ...)."""
    return not geo.crs.horizontal_crs(crs).is_geographic and bool(
        (ground_units_m(crs, place) == geo.crs.horizontal_unit(crs)).all()
    )


def nan_unless_finite(values: np.ndarray) -> np.ndarray:
    """Vectors (..., n) with every one that holds NaN or infinity (PROJ's mark of failure) made all NaN."""
    return np.where(np.isfinite(values).all(axis=-1, keepdims=True), values, np.nan)
