"""Tiles of an image with height hypotheses of their own, level or along a wall, and squares that see an area.

The latter by the rays through their corners and a height map.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from refract import BentPaths, FlatWater, PinholeCamera

COUNT_STEP = 8  # The number of hypotheses is a multiple of this and one: other numbers would need other kernels
# Side of the tiles of a part, with their halo: whole vectors, so that strips and tiles have the same kernels.
PART_SIDE_PX = 32


@dataclass(frozen=True)
class ImageTiles:
    """Tiles of an image that hold the wanted pixels, sorted by number of hypotheses; N of them."""

    wanted: np.ndarray  # (height, width) bool
    # size, radius: side of a tile without its halo, and width of the halo [px]
    size: int
    radius: int
    place: np.ndarray  # (N, 2) int: row and column among all tiles of the image
    start: np.ndarray  # (N,) float [m]: lowest hypothesis in the middle of the tile
    slope: np.ndarray  # (N, 2) float [m/px]: gradient of the hypotheses from row to row and from column to column
    counts: np.ndarray  # (N,) int: number of hypotheses

    @staticmethod
    def of(
        wanted: np.ndarray,
        bounds: tuple[np.ndarray, np.ndarray],
        step: float,
        size: int,
        radius: int,
        slope: np.ndarray | None = None,
    ) -> ImageTiles:
        """Tiles with hypotheses from below the lowest to above the highest height [m] of their wanted pixels.

        ``bounds`` (rows, columns) each are those that `extent` gives, ``slope`` (rows, columns, 2) [m/px] is that of
        each tile; those where it is NaN are left out.
        """
        least, most = bounds
        slope = np.zeros((*least.shape, 2)) if slope is None else slope
        place = np.argwhere(np.isfinite(least) & np.isfinite(slope).all(axis=-1))
        least, most, slope = (each[tuple(place.T)] for each in (least, most, slope))
        margin = step + 0.5 * size * np.abs(slope).sum(axis=-1)
        counts = np.ceil((most - least + 2.0 * margin) / step).astype(int) + 1
        counts = COUNT_STEP * -(-(counts - 1) // COUNT_STEP) + 1
        order = np.argsort(counts, kind="stable")
        return ImageTiles(wanted, size, radius, place[order], (least - margin)[order], slope[order], counts[order])

    @staticmethod
    def over(part: np.ndarray, shape: tuple[int, int], size: int, radius: int, count: int) -> ImageTiles:
        """Whole tiles of an image (height, width) that hold some of a part of it, with so many hypotheses each.

        The part, (rows, columns) bool, has a share of the size of the image.
        """
        of_row, of_column = (
            (np.arange(num) + 0.5) * length / num // size for num, length in zip(part.shape, shape, strict=True)
        )
        rows, columns = np.nonzero(part)
        place = np.unique(np.column_stack([of_row[rows], of_column[columns]]).astype(int), axis=0)
        mask = np.zeros([-(-length // size) for length in shape], dtype=bool)
        mask[tuple(place.T)] = True
        mask = mask.repeat(size, axis=0).repeat(size, axis=1)[: shape[0], : shape[1]]
        level = np.zeros((len(place), 2))
        return ImageTiles(mask, size, radius, place, level[:, 0], level, np.full(len(place), count))

    @property
    def side(self) -> int:
        """Side of a tile with its halo [px]."""
        return self.size + 2 * self.radius

    def batches(self, most: int, launch: int) -> Iterator[tuple[slice, int]]:
        """Batches of tiles with a common number of hypotheses, of at most ``most`` pixels times hypotheses.

        A batch ends where the next tile would cost those before it more than another launch: ``launch`` pixels times
        hypotheses.
        """
        first, pixels = 0, self.side**2
        while first < len(self.counts):
            counts, count = self.counts[first:], np.arange(1, len(self.counts) - first + 1)
            fits = pixels * count * counts <= most
            cheap = np.append(True, pixels * count[:-1] * np.diff(counts) <= launch)
            ends = np.flatnonzero(~(fits & cheap))
            run = max(int(ends[0]) if len(ends) else len(counts), 1)
            yield slice(first, first + run), int(counts[run - 1])
            first += run

    def pixels(self, part: slice) -> np.ndarray:
        """Flat indices (n, side, side) of the pixels of tiles with their halo."""
        rows, columns = self._lines(part)
        return rows[:, :, None] * self.wanted.shape[1] + columns[:, None, :]

    def starts(self, part: slice) -> np.ndarray:
        """Lowest hypotheses (n, side, side) float32 [m] of the pixels of tiles."""
        rows, columns = (
            (line + 0.5 - self.size * (self.place[part, axis, None] + 0.5)) * self.slope[part, axis, None]
            for axis, line in enumerate(self._lines(part))
        )
        rise = rows[:, :, None] + columns[:, None, :]
        return (self.start[part, None, None] + rise).astype(np.float32)

    def own(self, part: slice, pixels: np.ndarray) -> np.ndarray:
        """Mask (n, side, side) of the pixels that are wanted, in their own tile, and have a whole window in it."""
        inner = np.zeros(self.side, dtype=bool)
        inner[self.radius : -self.radius] = True
        rows, columns = (
            (line // self.size == self.place[part, axis, None]) & inner for axis, line in enumerate(self._lines(part))
        )
        return self.wanted.ravel()[pixels] & rows[:, :, None] & columns[:, None, :]

    def corners(self, part: slice) -> np.ndarray:
        """Row and column (n, 2) of the first pixel of tiles with their halo, moved into the image at its edges."""
        return np.clip(self.size * self.place[part] - self.radius, 0, np.array(self.wanted.shape) - self.side)

    def _lines(self, part: slice) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (n, side) of the pixels of tiles with their halo."""
        corner = self.corners(part)
        return corner[:, 0, None] + np.arange(self.side), corner[:, 1, None] + np.arange(self.side)


def in_tiles(image: np.ndarray, size: int, beyond: float) -> np.ndarray:
    """An image cut into tiles (rows, size, columns, size), continued by a value."""
    down, right = (-length % size for length in image.shape)
    image = np.pad(image, ((0, down), (0, right)), constant_values=beyond)
    return image.reshape(image.shape[0] // size, size, -1, size)


Area = tuple[float, float, float, float]

# Side of the squares at full size [px]: whole pixels of maps at a quarter of the size, of which there are at least so
# many along a side. And how many squares there are along the longer side of an image at most: more only cost time.
_QUARTERS, _LEAST_QUARTERS, _MOST_SQUARES = 4, 2, 64
_APART_M = 0.01  # Difference of the heights between which the slope of each leg of a ray is taken [m]


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
