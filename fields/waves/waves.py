"""Surfaces of the water in photographs, as the solver takes them, and how points of the bed are displaced by them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from fields.waves.surfaces import Posterior, Sea
from refract import kernels

# Waves over shallower water [m] displace by less than is measured.
LEAST_DEPTH = 0.1
_STEPS = 2
# Nodes of the raster of a surface to a spacing of its coefficients: cubic lookups keep waves of four spacings.
_FINER = 2
# A cubic B-spline and its slope at nodes, for correlation with coefficients.
_VALUES = np.array([1.0, 8.0, 23.0, 32.0, 23.0, 8.0, 1.0]) / 48.0
_SLOPES = np.array([-1.0, -4.0, -5.0, 0.0, 5.0, 4.0, 1.0]) / 8.0
# Linear steps of the search for where a ray meets the surface, each of which leaves a fifth of the error, or less.
_SEARCH_STEPS = 2
_LEVEL = (0.0, 0.0, 1.0)
# OpenCV takes positions as an image, with sides below 32768: they are laid out in lines of so many.
_LINE = 2048


@dataclass(frozen=True)
class Crossings:
    """Where rays from a camera to N points cross the plane z = 0, and how the points are displaced by a surface there.

    With the gradient g of the surface and its height s a point is displaced by
    ``depth (across g + along (along . g) curve) + by_height s``.
    """

    place: np.ndarray  # (2, N) [m]
    depth: np.ndarray  # (N,) [m]; 0 on dry ground
    across: np.ndarray  # (N,)
    along: np.ndarray  # (2, N): horizontal part of the direction in air
    curve: np.ndarray  # (N,)
    by_height: np.ndarray  # (2, N)

    @staticmethod
    def of(centre: np.ndarray, points: np.ndarray, n_water: float) -> Crossings:
        """Of a camera (3,) and points (3, N) [m]."""
        plane = kernels.WaterPlane((0.0, 0.0, 0.0), _LEVEL, n_water)
        crossing, depth = kernels.crossing_of_point(tuple(np.float32(c) for c in centre), tuple(points), plane, _STEPS)
        depth = np.maximum(depth, np.float32(0.0))
        place = np.stack(crossing[:2])
        air = place - np.asarray(centre[:2], dtype=np.float32)[:, None]
        height = np.float32(centre[2])
        length = np.sqrt((air**2).sum(axis=0) + height**2)
        along, cosine = air / length, height / length
        in_water = np.sqrt(1.0 - (1.0 - cosine**2) / n_water**2)
        bend = cosine / n_water - in_water
        across = (bend / in_water).astype(np.float32)
        curve = -(1.0 / n_water - cosine / (n_water**2 * in_water)) / (n_water * in_water**2)
        wet = depth > 0.0
        by_height = np.where(wet, air / height - along / (n_water * in_water), np.float32(0.0))
        return Crossings(place, depth, across, along, curve.astype(np.float32), by_height)

    def displacement(self, height: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Displacement (2, N) [m] by heights (N,) [m] and gradients (2, N) of a surface at the places."""
        turned = self.across * gradient + self.along * (self.curve * (self.along * gradient).sum(axis=0))
        return self.depth * turned + self.by_height * height

    @property
    def by_gradient(self) -> np.ndarray:
        """Change of the displacement (2, 2, N) [m] with the gradient."""
        return self.depth * (self.across * np.eye(2)[..., None] + self.curve * self.along[:, None] * self.along[None])


@dataclass(frozen=True)
class Waves:
    """Surfaces of V photographs, in the frame of the water, whose z is the height over its plane."""

    centres: np.ndarray  # (V, 3) [m]: of the cameras, over their own level of the water
    tides: np.ndarray  # (V,) [m]: of that level over the plane
    n_water: float
    corner: np.ndarray  # (V, 2) [m]: of the first coefficient
    spacing: float  # [m]
    coefficients: np.ndarray  # (V, columns, rows) float32 [m]: of cubic B-splines
    # (2, rows, columns) float32 [m^2]: variances of the height and the place of the bed by what is wrong with surfaces
    variance: np.ndarray
    variance_corner: np.ndarray  # (2,) [m]: of its first node; they are at the same spacing
    deep: float = 1.0  # [m]: depth that 95 % of the bed does not reach
    sea: Sea | None = None
    common_std: float = 0.0  # [m]: of the error of all heights alike, by what is wrong with surfaces
    # still_std, left_std [m]: of heights by waves, were the water taken as still, and by what is wrong with surfaces
    still_std: float = 0.0
    left_std: float = 0.0
    shown: int = 0  # The photograph that waves displace most
    # (N, 6) [m]: of places (2) of the bed in it, displacements (2) by waves, and what surfaces leave of them (2)
    shifts: np.ndarray = field(default_factory=lambda: np.empty((0, 6)))
    _rasters: dict[int, np.ndarray] = field(default_factory=dict, compare=False, repr=False)

    @staticmethod
    def still(centres: np.ndarray, tides: np.ndarray, n_water: float) -> Waves:
        """Cameras over still water."""
        none, origin = np.zeros((len(centres), 4, 4), dtype=np.float32), np.zeros(2)
        return Waves(centres, tides, n_water, np.zeros((len(centres), 2)), 1.0, none, none[:2], origin)

    def with_surfaces(self, found: Posterior, variance: np.ndarray, variance_corner: np.ndarray, deep: float) -> Waves:
        """The cameras over the surfaces that were found."""
        return replace(
            self, deep=deep, corner=found.grid.corner, spacing=found.grid.spacing, coefficients=found.coefficients,
            variance=variance, variance_corner=variance_corner, sea=found.sea, common_std=found.common_std,
            still_std=found.still_std, left_std=found.left_std, _rasters={},
        )  # fmt: skip

    def crossings(self, view: int, points: np.ndarray) -> Crossings:
        """Crossings of the rays from a camera to points (3, N) [m]."""
        over = points - np.array([[0.0], [0.0], [self.tides[view]]], dtype=np.float32)
        return Crossings.of(self.centres[view], over, self.n_water)

    def displacement(self, view: int, points: np.ndarray) -> np.ndarray:
        """Displacements (2, N) [m] along the plane at which a photograph shows points (3, N) [m]."""
        return self.through(view, points)[1]

    def through(self, view: int, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Places (2, N) [m] at which the rays to points (3, N) [m] meet a surface, and their `displacement`."""
        rays, (*centre, above) = self.crossings(view, points), self.centres[view].astype(np.float32)
        place, share = rays.place, above / (above + rays.depth / np.float32(self.n_water))
        aside = (place - np.array(centre)[:, None]) / above
        for _ in range(_SEARCH_STEPS):
            height, gradient = self.surface(view, place)
            place = rays.place + share * rays.displacement(height, gradient) - aside * height
        place, displacement = self._traced(view, place, points)
        return place, np.where(points[2] < self.tides[view], displacement, np.float32(0.0))

    def _traced(self, view: int, place: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Last step of `through`: places (2, N) [m] from guesses, and the displacements (2, N) [m] at these."""
        centre, depth = self.centres[view].astype(np.float32)[:, None], np.float32(self.tides[view]) - points[2]
        height, gradient = self.surface(view, place)
        air = np.vstack([place, height[None]]) - centre
        air /= np.sqrt((air**2).sum(axis=0))
        upward = 1.0 / np.sqrt(1.0 + (gradient**2).sum(axis=0))
        normal = -upward * gradient[0], -upward * gradient[1], upward
        (*water, down), (*still, down_still) = (
            kernels.bend(tuple(air), each, 1.0, self.n_water) for each in (normal, _LEVEL)
        )
        reached = place - np.stack(water) / down * (depth + height)
        without = place - air[:2] / air[2] * height - np.stack(still) / down_still * depth
        return place + points[:2] - reached, without - reached

    def surface(self, view: int, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Heights (N,) [m] and gradients (2, N) of a surface at places (2, N) [m]."""
        node = (place - self.corner[view][:, None]) * (_FINER / self.spacing)
        height, *slopes = interpolated(self.raster(view), node, cv2.INTER_CUBIC).T
        return height, np.stack(slopes)

    def raster(self, view: int) -> np.ndarray:
        """Height of a surface and its slopes (rows, columns, 3), at `_FINER` nodes to a spacing."""
        if view not in self._rasters:
            columns, rows = self.coefficients[view].shape
            fine = np.zeros((_FINER * rows, _FINER * columns), dtype=np.float32)
            fine[::_FINER, ::_FINER] = self.coefficients[view].T
            slope = _SLOPES / self.spacing
            filters = (_VALUES, _VALUES), (slope, _VALUES), (_VALUES, slope)
            self._rasters[view] = np.dstack([cv2.sepFilter2D(fine, -1, x, y) for x, y in filters])
        return self._rasters[view]

    def variances(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Variances (N,) [m^2] of heights and places of points of the bed (3, N) [m] by what is wrong with surfaces."""
        node = (points[:2] - self.variance_corner[:, None]) / self.spacing
        last = np.array(self.variance.shape[:0:-1])[:, None] - 1.0
        height, place = (interpolated(each, np.clip(node, 0.0, last), cv2.INTER_LINEAR) for each in self.variance)
        wet = points[2] < 0.0
        return np.where(wet, height, 0.0), np.where(wet, place, 0.0)


def interpolated(raster: np.ndarray, node: np.ndarray, interpolation: int) -> np.ndarray:
    """Values (N, ...) of a raster (rows, columns, ...) at nodes (2, N), column, row, by a flag of OpenCV; 0 beyond."""
    lines = -(-node.shape[1] // _LINE)
    at = np.zeros((2, lines * _LINE), dtype=np.float32)
    at[:, : node.shape[1]] = node
    across, down = at.reshape(2, lines, _LINE)
    found = cv2.remap(raster, across, down, interpolation, borderMode=cv2.BORDER_CONSTANT, borderValue=0.0)
    return found.reshape(-1, *raster.shape[2:])[: node.shape[1]]
