"""Tiles of an image with height hypotheses of their own: level, or along a wall."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

# The number of hypotheses is a multiple of this and one: other numbers would need other kernels.
COUNT_STEP = 8
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
    slope: np.ndarray  # (N, 2) float [m/px]: by which the hypotheses rise from row to row and from column to column
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
