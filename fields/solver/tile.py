"""Tiles of height maps: parts that are solved independently, each with a halo."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

from fields.image_store import GreyImages

# Most pixels of a tile's window, without its surroundings. Larger ones save no time and are less accurate: gain and
# noise of a photograph are those of a tile.
MOST_PX = 50_000
HALO_PX = 8  # How far the surroundings of a tile reach: several times the range over which heights are correlated
# Heights are solved this far around the pixels that are asked for, where other views confirm the sweep's height.
AROUND_PX = 3


@dataclass(frozen=True)
class SolverTile:
    """Pixels of one height map that are solved together; N of them."""

    # row, column: Of the first pixel of the window that holds them
    row: int
    column: int
    inside: np.ndarray  # (rows, columns) bool: which pixels of the window are solved
    requested: np.ndarray  # (N,) bool: whose heights are wanted; the others are their surroundings

    def __len__(self) -> int:
        return len(self.requested)

    @cached_property
    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Row and column in the window (N,) each."""
        rows, columns = np.nonzero(self.inside)
        return rows, columns

    @cached_property
    def pixels(self) -> np.ndarray:
        """Positions (N, 2) [px] in the image."""
        rows, columns = self.places
        return np.stack([columns + (self.column + 0.5), rows + (self.row + 0.5)], axis=-1)

    @cached_property
    def number(self) -> np.ndarray:
        """Number of each pixel of the window among the N; -1 where it is none of them."""
        number = np.full(self.inside.shape, -1)
        number[self.inside] = np.arange(len(self))
        return number

    def of(self, image: np.ndarray) -> np.ndarray:
        """The N pixels of an image."""
        return self.window(image)[self.inside]

    def window(self, image: np.ndarray) -> np.ndarray:
        """The part of an image in which the tile lies."""
        return image[self._window]

    def window_of_view(self, images: GreyImages | Mapping[int, np.ndarray], view: int) -> np.ndarray:
        """The part of the image of a view in which the tile lies."""
        return images.window(view, *self._window) if isinstance(images, GreyImages) else self.window(images[view])

    @property
    def _window(self) -> tuple[slice, slice]:
        rows, columns = self.inside.shape
        return slice(self.row, self.row + rows), slice(self.column, self.column + columns)


def tiles_of(wanted: np.ndarray, confirmed: np.ndarray, side: int | None = None) -> Iterator[SolverTile]:
    """Tiles that contain every wanted pixel (height, width) bool once, with confirmed pixels around them.

    They are squares of ``side`` pixels, without their surroundings; without it, parts that are close about what is
    wanted, so that a map of which little is takes few.
    """
    solved = (ndimage.binary_dilation(wanted, iterations=AROUND_PX) & confirmed) | wanted
    for top, bottom, left, right in _halves(wanted) if side is None else _squares(wanted.shape, side):
        core = np.s_[top:bottom, left:right]
        if not wanted[core].any():
            continue
        row, column = max(top - HALO_PX, 0), max(left - HALO_PX, 0)
        window = np.s_[row : bottom + HALO_PX, column : right + HALO_PX]
        inside, requested = solved[window].copy(), np.zeros_like(solved[window])
        requested[top - row : bottom - row, left - column : right - column] = wanted[core]
        yield SolverTile(row, column, inside, requested[inside])


def requested_in_squares(wanted: np.ndarray, side: int) -> list[int]:
    """Number of wanted pixels in each of the tiles that `tiles_of` makes with a side."""
    counts = (
        int(np.count_nonzero(wanted[top:bottom, left:right]))
        for top, bottom, left, right in _squares(wanted.shape, side)
    )
    return [count for count in counts if count]


def _squares(shape: tuple[int, ...], side: int) -> Iterator[tuple[int, int, int, int]]:
    """Top, bottom, left and right of squares that cover an image."""
    height, width = shape
    for top in range(0, height, side):
        for left in range(0, width, side):
            yield top, min(top + side, height), left, min(left + side, width)


def _halves(wanted: np.ndarray) -> Iterator[tuple[int, int, int, int]]:
    """Top, bottom, left and right of the parts of a recursive bisection, each cropped to its wanted pixels."""
    waiting = [(0, wanted.shape[0], 0, wanted.shape[1])]
    while waiting:
        top, bottom, left, right = waiting.pop()
        part = wanted[top:bottom, left:right]
        rows, columns = (np.flatnonzero(part.any(axis=axis)) for axis in (1, 0))
        if not len(rows):
            continue
        top, bottom = top + int(rows[0]), top + int(rows[-1]) + 1
        left, right = left + int(columns[0]), left + int(columns[-1]) + 1
        if (bottom - top) * (right - left) <= MOST_PX:
            yield top, bottom, left, right
        elif bottom - top > right - left:
            middle = (top + bottom) // 2
            waiting += [(middle, bottom, left, right), (top, middle, left, right)]
        else:
            middle = (left + right) // 2
            waiting += [(top, bottom, middle, right), (top, bottom, left, middle)]
