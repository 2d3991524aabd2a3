"""Parts of height maps that are solved on their own, each within its surroundings."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import ndimage

# Side of a tile, and how far its surroundings reach: several times the range over which heights are correlated.
TILE_PX, HALO_PX = 192, 8
# Heights are solved this far around the pixels that are asked for, where other views confirm the sweep's height.
AROUND_PX = 3


@dataclass(frozen=True)
class Tile:
    """Pixels of one height map that are solved together; N of them.

    Attributes
    ----------
    row, column : int
        Of the first pixel of the window that holds them.
    inside : (rows, columns) bool
        Which pixels of the window are solved.
    asked : (N,) bool
        Whose heights are wanted; the others are their surroundings.
    """

    row: int
    column: int
    inside: np.ndarray
    asked: np.ndarray

    def __len__(self) -> int:
        return len(self.asked)

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
        rows, columns = self.inside.shape
        return image[self.row : self.row + rows, self.column : self.column + columns]


def tiles_of(wanted: np.ndarray, confirmed: np.ndarray, side: int = TILE_PX) -> Iterator[Tile]:
    """Tiles that hold every wanted pixel (height, width) bool once, with what is confirmed around them.

    They are ``side`` pixels wide and high, without their surroundings.
    """
    solved = (ndimage.binary_dilation(wanted, iterations=AROUND_PX) & confirmed) | wanted
    height, width = wanted.shape
    for top in range(0, height, side):
        for left in range(0, width, side):
            core = np.s_[top : top + side, left : left + side]
            if not wanted[core].any():
                continue
            row, column = max(top - HALO_PX, 0), max(left - HALO_PX, 0)
            window = np.s_[row : top + side + HALO_PX, column : left + side + HALO_PX]
            inside, asked = solved[window].copy(), np.zeros_like(solved[window])
            asked[top - row : top - row + side, left - column : left - column + side] = wanted[core]
            yield Tile(row, column, inside, asked[inside])
