"""Rays through the corners of squares of an image: with a height map they tell which squares may see an area."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fields.sweep.tiles import in_tiles
from refract import BentPaths, FlatWater, PinholeCamera

Area = tuple[float, float, float, float]

# Side of the squares at full size [px]: whole pixels of maps at a quarter of the size, of which there are at least so
# many along a side. And how many squares there are along the longer side of an image at most: more only cost time.
_QUARTERS, _LEAST_QUARTERS, _MOST_SQUARES = 4, 2, 64
# Difference of the heights between which the slope of each leg of a ray is taken [m].
_APART_M = 0.01


@dataclass(frozen=True)
class CornerRays:
    """Rays through the corners (rows, columns) of the squares of a view: straight on either side of the water."""

    level: float  # [m]: height at which rays bend, over the plane that heights count from
    foot: np.ndarray  # (rows, columns, 2) float32 [m], local: place at that height
    # (rows, columns, 2) float32 [m/m]: change of the place per metre of height above it and below
    above: np.ndarray
    below: np.ndarray

    @staticmethod
    def of(camera: PinholeCamera, water: FlatWater | None, squares: tuple[int, int]) -> CornerRays:
        """Rays of a view of full size with so many rows and columns of squares."""
        side = side_of_squares(camera)
        row, column = (
            np.minimum(np.arange(count + 1) * side, length)
            for count, length in zip(squares, (camera.height, camera.width), strict=True)
        )
        paths = camera.paths(np.stack(np.meshgrid(column, row), axis=-1).reshape(-1, 2).astype(float), water)
        if water is None:
            return CornerRays._straight(camera, paths, (len(row), len(column)))
        level = camera.tide * float(water.up[2])
        low, foot, high = (
            paths.at_height(np.full(len(row) * len(column), level + by), water)[:, :2].reshape(len(row), -1, 2)
            for by in (-_APART_M, 0.0, _APART_M)
        )
        legs = (foot, (high - foot) / _APART_M, (foot - low) / _APART_M)
        return CornerRays(level, *(each.astype(np.float32) for each in legs))

    @staticmethod
    def _straight(camera: PinholeCamera, paths: BentPaths, shape: tuple[int, int]) -> CornerRays:
        """Rays in air alone, from the camera on: nothing above it lies on a ray that falls, nothing below on others."""
        x, y, z = paths.air_direction.T
        level = float(camera.centre[2])
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.column_stack([x, y]) / z[:, None]
            foot = paths.origin[:, :2] + (level - paths.origin[:, 2:]) * slope
            above, below = (np.where(is_ahead[:, None], slope, np.nan) for is_ahead in (z > 0.0, z < 0.0))
        return CornerRays(level, *(each.reshape(*shape, 2).astype(np.float32) for each in (foot, above, below)))

    def places(self, height: np.ndarray) -> np.ndarray:
        """Places (rows, columns, 2) float32 [m], local, of the rays at heights (rows, columns) [m]."""
        over = (height - np.float32(self.level))[..., None]
        return self.foot + over * np.where(over > 0.0, self.above, self.below)


def side_of_squares(camera: PinholeCamera) -> int:
    """Side of the squares of a view of full size [px]."""
    return _QUARTERS * max(_LEAST_QUARTERS, -(-max(camera.height, camera.width) // (_QUARTERS * _MOST_SQUARES)))


def extremes_of_squares(camera: PinholeCamera, height: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Least and largest heights [m] of the squares of a map of a view, and their side in it [px]."""
    side = max(round(side_of_squares(camera) * height.shape[1] / camera.width), 1)
    # One axis after the other: numpy vectorises no reduction over both.
    low = in_tiles(height, side, np.inf).min(axis=1).min(axis=2)
    return low, in_tiles(height, side, -np.inf).max(axis=1).max(axis=2), side


def squares_over_area(rays: CornerRays, area: Area, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Squares (rows, columns) bool that see an area at heights [m] between theirs, or those of the squares beside."""
    # Of the squares about each corner.
    ends = (
        of_corners(choose, np.pad(each, 1, mode="edge")) for choose, each in ((np.minimum, low), (np.maximum, high))
    )
    places = [rays.places(each) for each in ends]
    least, most = of_corners(np.fmin, np.fmin(*places)), of_corners(np.fmax, np.fmax(*places))
    return np.asarray(((least <= area[2:]) & (most >= area[:2])).all(axis=-1))


def of_corners(choose: np.ufunc, value: np.ndarray) -> np.ndarray:
    """Least or largest of the values of each two by two neighbours."""
    pairs = choose(value[:-1], value[1:])
    return choose(pairs[:, :-1], pairs[:, 1:])
