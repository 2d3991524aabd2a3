"""The local frame of a survey: topocentric east, north, up, in metres.

`crs` -> geographic (the map projection undone) -> geocentric -> topocentric at the origin. Grid scale, height
scale and meridian convergence are gone in `local`. Heights are used as they are, as if they were above the
ellipsoid: an undulation of 50 m changes scale by 8e-6, and no geoid grid is needed.

Similarities b = s R a + t are fitted by least squares, also where up to half of the points are wrong.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from pyproj import CRS
from scipy.special import stdtrit

from geo import projection
from geo.crs import AREA_MARGIN_DEG, EARTH_RADIUS_M, degrees_outside_area, parse_crs
from geo.errors import PlaceMismatch

_MIN_POINTS = 3
_DRAWS = 500
# Median length of a vector of three unit normals: the root of the median of chi-square with 3 degrees of freedom.
_MEDIAN_LENGTH = 1.538
# The parameters of a similarity.
_PARAMETERS = 7
# A position is a gross error beyond this many std, or, where few points determine it, beyond the quantile of one in a
# million: residuals of deformed blocks have long tails. Never below the difference of a fixed and a float RTK solution.
_WRONG_STD, _WRONG_PROBABILITY, _WRONG_AT_LEAST_M = 6.0, 1e-6, 0.6


@dataclass(frozen=True)
class Similarity:
    """``b = scale * rotation @ a + shift``."""

    scale: float  # [-]
    rotation: np.ndarray  # (3, 3)
    shift: np.ndarray  # (3,)

    def __call__(self, points) -> np.ndarray:
        """Points (..., 3) of a in b."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.shift


def fit_similarity(a, b) -> Similarity:
    """The similarity that takes points a (N, 3) to b (N, 3) with the least sum of squared distances.

    Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns", equations 34 to
    43; never a reflection.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    from_a, from_b = a - mean_a, b - mean_b
    u, lengths, vt = np.linalg.svd(from_b.T @ from_a)
    signs = np.array([1.0, 1.0, math.copysign(1.0, np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((lengths * signs).sum() / (from_a**2).sum())
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def robust_similarity(a, b) -> tuple[Similarity, np.ndarray]:
    """The similarity fitted to all points that agree, and which (N,) do; up to half of them may be wrong.

    Least median of squares over seeded samples of three points (Rousseeuw 1984, "Least median of squares
    regression"), which needs no threshold; then fits to the points within `gross_error_limit`, while these change.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if len(a) < _MIN_POINTS:
        raise ValueError(f"a similarity needs {_MIN_POINTS} points, got {len(a)}")
    best = fit_similarity(a, b)
    least = np.median(_distances(best, a, b))
    rng = np.random.default_rng(0)
    for _ in range(_DRAWS if len(a) > _MIN_POINTS else 0):
        pick = rng.choice(len(a), _MIN_POINTS, replace=False)
        trial = fit_similarity(a[pick], b[pick])
        median = np.median(_distances(trial, a, b))
        if median < least:
            best, least = trial, median
    agree = np.zeros(len(a), dtype=bool)
    # Two or three rounds are usual; the limit ends an oscillation between two sets.
    for _ in range(20):
        distances = _distances(best, a, b)
        wrong = gross_error_limit(float(np.median(distances)), max(int(agree.sum()), len(a) // 2 + 1, _MIN_POINTS))
        before, agree = agree, distances <= wrong
        if (agree == before).all() or agree.sum() < _MIN_POINTS:
            break
        best = fit_similarity(a[agree], b[agree])
    return best, agree


def gross_error_limit(median: float, num: int) -> float:
    """Distance [m] beyond which a point is a gross error of a similarity fitted to ``num`` consistent points.

    By the median of the distances of all points [m]: six times the standard deviation that it gives, at least the limit
    by Student's distribution with the degrees of freedom that remain, and never below 0.6 m.
    """
    free = 3 * num - _PARAMETERS
    spread = median / _MEDIAN_LENGTH * math.sqrt(3 * num / free)
    return max(max(_WRONG_STD, -float(stdtrit(free, 0.5 * _WRONG_PROBABILITY))) * spread, _WRONG_AT_LEAST_M)


def _distances(similarity: Similarity, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(similarity(a) - b, axis=1)


# Half a step for differentiation along the grid axes. Rounding of geocentric metres gives 1e-9 / 10 rad,
# curvature (10 m / 6.4e6 m)² = 2e-12 rad.
_STEP_M = 10.0


@dataclass(frozen=True)
class LocalFrame:
    """Topocentric Cartesian frame whose horizontal plane touches the ellipsoid at one point of a survey.

    Use one frame per thread: PROJ's transformations must not be shared between threads. Raises GeoError as
    `geo.crs.parse_crs`; PlaceMismatch if the origin is not finite, not on the map, or more than 10 degrees outside the
    area that the CRS is made for.
    """

    crs: CRS  # Compound (horizontal + vertical) or 3D, see `geo.crs.parse_crs`
    origin: tuple[float, float, float]  # easting or longitude, northing or latitude, height: becomes (0, 0, 0)
    _map: projection.MapProjection = field(init=False, repr=False, compare=False)
    _origin_lon: float = field(init=False, repr=False, compare=False)
    _origin_geocentric: np.ndarray = field(init=False, repr=False, compare=False)
    _local_from_geocentric: np.ndarray = field(init=False, repr=False, compare=False)

    def __post_init__(self):
        def keep(name, value):
            object.__setattr__(self, name, value)

        keep("crs", parse_crs(self.crs))
        keep("origin", tuple(float(v) for v in self.origin))
        keep("_map", projection.MapProjection(self.crs))
        lon, lat, height = self._checked_origin()
        keep("_origin_lon", lon)
        keep("_origin_geocentric", projection.geocentric_from_geodetic(lon, lat, height, a=self._map.a, b=self._map.b))
        keep("_local_from_geocentric", projection.enu_from_geocentric(lon, lat))

    def local_from_crs(self, points) -> np.ndarray:
        """Points (..., 3) in crs as float64 [m], local; NaN where a point is not finite or not on the map."""
        lon, lat, height = self._map.geodetic_from_crs(_as_points(points))
        xyz = projection.geocentric_from_geodetic(lon, lat, height, a=self._map.a, b=self._map.b)
        return (xyz - self._origin_geocentric) @ self._local_from_geocentric.T

    def crs_from_local(self, points) -> np.ndarray:
        """Points (..., 3) [m], local, as float64 in crs; NaN where a point is not finite.

        The inverse of `local_from_crs` to 2e-8 m. Longitudes stay within half a turn of the origin: a survey across the
        antimeridian stays in one piece.
        """
        xyz = projection.nan_unless_finite(_as_points(points)) @ self._local_from_geocentric + self._origin_geocentric
        lon, lat, height = projection.geodetic_from_geocentric(xyz, a=self._map.a, b=self._map.b)
        half_turns = np.round((lon - self._origin_lon) / (2.0 * math.pi))
        return self._map.crs_from_geodetic(lon - 2.0 * math.pi * half_turns, lat, height)

    def from_frame(self, other: LocalFrame) -> Similarity:
        """Rigid transform of points [m] in another local frame of the same CRS into this one, to rounding (1e-9 m)."""
        if other.crs != self.crs:
            raise ValueError(f"expected a local frame of {self.crs.name}, got one of {other.crs.name}")
        rotation = self._local_from_geocentric @ other._local_from_geocentric.T
        between = other._origin_geocentric - self._origin_geocentric
        return Similarity(1.0, rotation, self._local_from_geocentric @ between)

    def local_from_grid(self, point_crs) -> np.ndarray:
        """Rotation (..., 3, 3) that turns the grid axes at points (..., 3) in crs into local axes; NaN off the map.

        Grid axes are the directions in which easting (longitude), northing (latitude) and height grow there; the
        angles of photogrammetry are rotations about them. Central differences of `local_from_crs`, each of unit length,
        replaced by the nearest rotation.
        """
        points = _as_points(point_crs)
        steps = self._steps(points)
        ends = [self.local_from_crs(points[..., None, :] + step) for step in (steps, -steps)]
        columns = np.swapaxes(ends[0] - ends[1], -1, -2)
        columns = columns / np.linalg.norm(columns, axis=-2, keepdims=True)
        finite = np.isfinite(columns).all(axis=(-1, -2))[..., None, None]
        u, _, vt = np.linalg.svd(np.where(finite, columns, np.eye(3)))
        return np.where(finite, u @ vt, np.nan)

    def local_from_enu(self, point_crs) -> np.ndarray:
        """Rotation (..., 3, 3) that turns true east, true north and up at points (..., 3) in crs into local axes."""
        lon, lat, _ = self._map.geodetic_from_crs(_as_points(point_crs))
        return self._local_from_geocentric @ np.swapaxes(projection.enu_from_geocentric(lon, lat), -1, -2)

    def _steps(self, points: np.ndarray) -> np.ndarray:
        """Steps (..., 3, 3) of about `_STEP_M` along easting, northing and height, in units of crs."""
        unit = self._map.horizontal_unit
        east = np.full(points.shape[:-1], _STEP_M / unit)
        north = east
        if self._map.is_geographic:
            north = east / EARTH_RADIUS_M
            east = north / np.maximum(np.cos(points[..., 1] * unit), 1e-6)
        up = np.full_like(east, _STEP_M / self._map.height_unit_m)
        return np.stack([east, north, up], axis=-1)[..., None] * np.eye(3)

    def _checked_origin(self) -> tuple[float, float, float]:
        """Longitude, latitude [rad] and height [m] of the origin, which must lie where the CRS applies."""
        message = f"the origin {self.origin} in {self.crs.name}"
        if len(self.origin) != 3 or not all(math.isfinite(v) for v in self.origin):
            raise PlaceMismatch(f"{message} is not three finite numbers; give easting, northing and height.")
        lon, lat, height = (float(v) for v in self._map.geodetic_from_crs(np.array(self.origin)))
        order = "check the CRS, and that easting (or longitude) comes before northing (or latitude)."
        if not (math.isfinite(lon) and abs(lat) <= 0.5 * math.pi):
            raise PlaceMismatch(f"{message} is not on the map; {order}")
        excess = degrees_outside_area(self.crs, lon, lat)
        if excess > AREA_MARGIN_DEG:
            raise PlaceMismatch(
                f"{message} lies {excess:.0f} degrees outside the area that this CRS is made for; {order}"
            )
        return lon, lat, height


def _as_points(points) -> np.ndarray:
    points = np.asarray(points, dtype=np.float64)
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"expected points of shape (..., 3), got {points.shape}")
    return points
