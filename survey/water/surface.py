"""Water that is not a plane: its height over the plane of the survey, as measured or by the curvature of the Earth.

Local regression (W. S. Cleveland 1979): at each place a surface of second order is fitted to the nearest points,
weighted by distance and accuracy. The number of points is chosen by leave-one-out cross-validation. It works for
rasters, points anywhere on the surface, and lines of levels along a river; across a line the slope is that of the
plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import KDTree

from evaluation.summary import std_by_median
from geo.crs import EARTH_RADIUS_M, height_unit_m
from geo.frames import LocalFrame
from refract import FlatWater
from refract.curved import BicubicWater
from survey.display.quantities import length
from survey.water.level_observation import LevelObservation

Area = tuple[float, float, float, float]
SURFACE = "surface"
# Numbers of nearest points to choose from, half of all at most; else the surface is one plane.
_NUMBERS = (12, 20, 30, 50, 80, 120)
# The smoothest surface is chosen whose squared errors are at most this many times the least, as noise also bends rays.
_AS_GOOD = 1.1
# Points that are left out in turn, for each number of neighbours.
_LEFT_OUT = 400
# Ridge on slopes and curvatures, as a share of the weights: across a line of points nothing else determines them.
_RIDGE = (1e-2, 1e-2, 2e-3, 2e-3, 2e-3)
# Least error of a file [m].
_LEAST_STD_M = 1e-3
# Shift of the bed per error of the level: n - 1 for rays near the vertical, more for oblique ones.
_BED_PER_LEVEL = 0.333
# Nodes of a raster at most, and of a batch.
_MOST_NODES, _AT_ONCE = 200_000, 20_000
# Nodes beyond an area that bicubic interpolation needs.
_BEYOND = 3
# Points whose spread across a line is less than this share of that along it do not determine a slope across it.
_LINE = 0.05
EARTH = "curvature of the Earth"
# Least drop [m] that is modelled, reached at 250 m: it changes depths by as much, and heights of the bed by 1.7 mm.
_LEAST_DROP_M = 5e-3
# Places along each side at which its height is computed.
_NODES = 13


def curvature_drop(distance, radius: float = EARTH_RADIUS_M):
    """Drop of a level surface below its tangent plane [m], ``distance`` [m] from where they touch.

    ``R - sqrt(R^2 - d^2)``, written without the difference: 2.0 cm at 500 m, 7.8 cm at 1 km.
    """
    return distance**2 / (radius + np.sqrt(radius**2 - distance**2))


class Departure:
    """Height of the water over the plane of a survey, from points on it; if an adjustment moves the plane, it moves.

    Points (N, 3) float64 [m] are local x and y, and the height over the plane; stds (N,) [m] are those of these
    heights, without what all share.
    """

    source = "[water] surface"  # What departs from the plane, in words

    def __init__(self, points: np.ndarray, stds: np.ndarray):
        self.points, self.stds, xy = points, stds, points[:, :2]
        self._tree, self._plane = KDTree(xy), _plane_through(points, 1.0 / stds)
        errors = {0: (self._over_plane(xy) - points[:, 2]) / stds}
        errors |= {number: self._left_out(number) for number in _NUMBERS if 2 * number <= len(xy)}
        # Residuals are clipped at five standard deviations.
        least = float(np.mean((_LEAST_STD_M / stds) ** 2))
        squares = {number: least + float(np.mean(np.minimum(np.abs(errors[number]), 5.0) ** 2)) for number in errors}
        good = [number for number in errors if squares[number] <= _AS_GOOD * min(squares.values())]
        self._number = 0 if 0 in good else max(good)
        self._factor = max(float(std_by_median(errors[self._number])), 1.0)

    @staticmethod
    def of(levels: Sequence[LevelObservation], frame: LocalFrame, plane: FlatWater | None) -> Departure | None:
        """Surface by measurements of the source `surface`; None where there are none."""
        found = [level for level in levels if level.source == SURFACE]
        if not found or plane is None:
            return None
        unit = height_unit_m(frame.crs)
        places = [(*level.place, level.level_m / unit) for level in found if level.place is not None]
        points = frame.local_from_crs(np.array(places))
        points[:, 2] -= plane.height(points[:, 0], points[:, 1])
        return Departure(points, np.array([level.std_m for level in found]))

    def at(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights over the plane and their standard deviations, (M,) each [m], at places (M, 2)."""
        parts = [self._near(xy[first : first + _AT_ONCE]) for first in range(0, len(xy), _AT_ONCE)]
        heights, stds = (np.concatenate(column) for column in zip(*parts, strict=True))
        return heights, stds

    def tangent(self, places: np.ndarray, plane: FlatWater) -> FlatWater:
        """The plane that fits the water best at places (M, 2), for the plane that heights count from."""
        heights, _ = self.at(places)
        over, slope_x, slope_y = _plane_through(np.column_stack([places, heights]), np.ones(len(places))).tolist()
        x, y = places.mean(axis=0).tolist()
        z = float(plane.height(x, y)) + over + slope_x * x + slope_y * y
        return replace(plane, point=(x, y, z), slope_x=plane.slope_x + slope_x, slope_y=plane.slope_y + slope_y)

    def over(self, plane: FlatWater, other: FlatWater) -> Departure:
        """The same water with heights over another plane."""
        points = self.points.copy()
        points[:, 2] += plane.height(*points[:, :2].T) - other.height(*points[:, :2].T)
        return type(self)(points, self.stds)

    def surface(self, area: Area, plane: FlatWater) -> BicubicWater:
        """The water over a rectangle (x0, y0, x1, y1), with the plane that heights count from."""
        x, y, heights, _ = self._raster(area)
        levels = heights + plane.height(*np.meshgrid(x, y))
        return BicubicWater((float(x[0]), float(y[0])), float(x[1] - x[0]), levels, n_water=plane.n_water)

    def interpolated(self, area: Area) -> Callable[[np.ndarray], np.ndarray]:
        """Heights over the plane as a function of places (M, 2), beyond a rectangle (x0, y0, x1, y1) as at its edge."""
        return _between(*self._raster(area)[:3])

    def interpolated_std(self, area: Area) -> Callable[[np.ndarray], np.ndarray]:
        """Standard deviations of these heights in the same form."""
        x, y, _, stds = self._raster(area)
        return _between(x, y, stds)

    def _raster(self, area: Area) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Even x and y, as far apart as the points are, and heights and stds (rows, columns)."""
        corner, size = np.array(area[:2]), np.array(area[2:]) - area[:2]
        nearest = float(np.median(self._tree.query(self.points[:, :2], k=min(2, len(self.points)))[0][:, -1]))
        spacing = max(nearest, math.sqrt(float(np.prod(size)) / _MOST_NODES), 1e-3 * float(size.max()))
        columns, rows = (np.ceil(size / spacing).astype(int) + 1 + 2 * _BEYOND).tolist()
        x, y = (
            start + spacing * (np.arange(count) - _BEYOND)
            for start, count in zip(corner.tolist(), (columns, rows), strict=True)
        )
        heights, stds = self.at(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
        return x, y, heights.reshape(rows, columns), stds.reshape(rows, columns)

    def _left_out(self, number: int) -> np.ndarray:
        """Errors of points, each from its neighbours without itself, in units of its std."""
        chosen = np.unique(np.linspace(0, len(self.points) - 1, _LEFT_OUT).astype(int))
        at = self.points[chosen]
        distance, near = self._tree.query(at[:, :2], k=number + 1)
        heights, _ = self._fitted(at[:, :2], distance[:, 1:], near[:, 1:])
        return (heights - at[:, 2]) / self.stds[chosen]

    def _near(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if not self._number:
            middle = self.points[:, :2].mean(axis=0)
            distance, spread = (np.sum((each - middle) ** 2, axis=1) for each in (xy, self.points[:, :2]))
            std = self._factor * float(np.sqrt(np.mean(self.stds**2)))
            return self._over_plane(xy), std * np.sqrt(1.0 / len(spread) + distance / spread.sum())
        distance, near = self._tree.query(xy, k=self._number)
        # Beyond the points the water goes on as the plane of the survey does, from where they end.
        reach = np.maximum(self._tree.query(self.points[near[:, 0], :2], k=self._number)[0][:, -1], 1e-9)
        nearest = self.points[near[:, 0], :2]
        held = nearest + (xy - nearest) * np.minimum(1.0, reach / np.maximum(distance[:, 0], 1e-12))[:, None]
        moved = np.linalg.norm(self.points[near][:, :, :2] - held[:, None], axis=-1)
        heights, stds = self._fitted(held, moved, near)
        return heights, self._factor * stds

    def _over_plane(self, xy: np.ndarray) -> np.ndarray:
        return self._plane[0] + xy @ self._plane[1:]

    def _fitted(self, xy: np.ndarray, distance: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights and stds (M,) of second-order surfaces through points ``near``, ``distance`` [m] away, (M, K)."""
        reach = np.maximum(1.001 * distance.max(axis=1), 1e-9)
        weights = (1.0 - np.minimum(distance / reach[:, None], 1.0) ** 3) ** 3 / self.stds[near] ** 2
        offsets = (self.points[near][:, :, :2] - xy[:, None]) / reach[:, None, None]
        residuals = self.points[near][:, :, 2] - self._over_plane(self.points[near][:, :, :2])
        east, north = offsets[..., 0], offsets[..., 1]
        design = np.stack([np.ones(near.shape), east, north, east**2, east * north, north**2], axis=-1)
        weighted = design * weights[:, :, None]
        normal = np.einsum("mki,mkj->mij", weighted, design)
        terms = np.arange(1, 6)
        normal[:, terms, terms] += np.array(_RIDGE) * normal[:, :1, 0]
        # Weights with which each point enters the height.
        shares = np.einsum("mi,mki->mk", np.linalg.solve(normal, np.eye(6)[:, :1])[..., 0], weighted)
        std = np.sqrt(np.sum((shares * self.stds[near]) ** 2, axis=1))
        return self._over_plane(xy) + np.sum(shares * residuals, axis=1), std


def departure_of(points: np.ndarray, stds: np.ndarray) -> float:
    """Root mean square [m] by which the water through points (N, 3) [m] departs from a plane; 0 where it is one."""
    if not np.ptp(points[:, :2], axis=0).max() > 0.0:
        return 0.0
    around = points - points.mean(axis=0)
    departure = Departure(around, stds)
    heights, _ = departure.at(around[:, :2])
    flat = np.column_stack([np.ones(len(around)), around[:, :2]])
    return float(np.std(heights - flat @ np.linalg.lstsq(flat, heights, rcond=None)[0]))


def plane_warning(points: np.ndarray, stds: np.ndarray, level_std_m: float, source: str) -> str | None:
    """Warning where points (N, 3) [m] on the water, of these stds, depart from a plane by more than that of its level.

    ``source`` is their key of [water].
    """
    departure = departure_of(points, stds)
    if departure <= level_std_m:
        return None
    bed, stated = (length(_BED_PER_LEVEL * value) for value in (departure, level_std_m))
    return (
        f"one plane is not enough for the water: the points in [water] {source} depart from it by {length(departure)} "
        f"(rms), far above their scatter, which moves the bed by {bed} or more, while the std of the level accounts "
        f"for {stated}; give them as surface in place of {source} (docs/waterline.md)"
    )


def height_above(plane: FlatWater, departure: Departure | None, places: np.ndarray) -> np.ndarray:
    """Heights (N,) [m] of places (N, 3), local, above the water: a plane, or what departs from it."""
    over = 0.0 if departure is None else departure.at(places[:, :2])[0]
    return -plane.depth(places) - over


def plane_under(plane: FlatWater | None, departure: Departure | None, centre: np.ndarray) -> FlatWater | None:
    """The plane that fits the water best around a camera at (3,) [m], local, within a radius of its flying height."""
    if plane is None or departure is None:
        return plane
    reach = max(float(height_above(plane, departure, centre[None])[0]), 1.0)
    around = np.stack(np.meshgrid(*[(-reach, 0.0, reach)] * 2), axis=-1).reshape(-1, 2)
    return departure.tangent(centre[:2] + around, plane)


def _between(x: np.ndarray, y: np.ndarray, values: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Values (rows, columns) at nodes x and y as a function of places (M, 2); beyond them that of the nearest place."""
    from scipy.interpolate import RegularGridInterpolator

    inside = RegularGridInterpolator((x, y), values.T, bounds_error=False, fill_value=np.nan)
    low, high = np.array([x[0], y[0]]), np.array([x[-1], y[-1]])
    return lambda places: inside(np.clip(places, low, high))


def _plane_through(points: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Height at the origin and slopes along x and y of the plane through points (N, 3); level across a line."""
    middle = np.average(points, axis=0, weights=weights**2)
    around = (points - middle) * weights[:, None]
    slopes = np.linalg.lstsq(around[:, :2], around[:, 2], rcond=_LINE)[0]
    return np.array([middle[2] - slopes @ middle[:2], *slopes])


class StillWater(Departure):
    """Heights over the plane of water that has one height in crs: of second order, a micrometre off at 10 km."""

    source = EARTH

    def __init__(self, points: np.ndarray, stds: np.ndarray):
        self.points, self.stds, self._tree = points, stds, KDTree(points[:, :2])
        self._middle, self._size = points[:, :2].mean(axis=0), float(np.ptp(points[:, :2], axis=0).max())
        self._terms = np.linalg.lstsq(self._design(points[:, :2]), points[:, 2], rcond=None)[0]

    def _design(self, xy: np.ndarray) -> np.ndarray:
        x, y = ((xy - self._middle) / self._size).T
        return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)

    def _near(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._design(xy) @ self._terms, np.zeros(len(xy))


def still_water(frame: LocalFrame, plane: FlatWater, centres: np.ndarray) -> StillWater | None:
    """Heights over the plane of water that has one height in crs; None where the plane is as good.

    The plane touches the water at its point, apart from slopes that both have; ``centres`` (N, 3) [m], local, tell
    how far the survey reaches.
    """
    point, xy = np.array(plane.point), centres[:, :2]
    if not curvature_drop(np.linalg.norm(xy - point[:2], axis=1).max()) > _LEAST_DROP_M:
        return None
    place = frame.crs_from_local(point)
    up = frame.local_from_grid(place)[:, 2]
    # With the point, since cameras may all hover at one place.
    reached = np.vstack([xy, point[:2]])
    middle, half = 0.5 * (reached.min(axis=0) + reached.max(axis=0)), 0.6 * np.ptp(reached, axis=0).max()
    nodes = np.linspace(-half, half, _NODES)
    ground = middle + np.stack(np.meshgrid(nodes, nodes), axis=-1).reshape(-1, 2)

    def touching(at: np.ndarray) -> np.ndarray:
        return point[2] - (at - point[:2]) @ up[:2] / up[2]

    level = frame.crs_from_local(np.column_stack([ground, touching(ground)]))
    level[:, 2] = place[2]
    points = frame.local_from_crs(level)
    points[:, 2] -= touching(points[:, :2])
    return StillWater(points, np.zeros(len(points)))
