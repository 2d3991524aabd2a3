"""Which pixels of many images: a bit each."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np


class Masks(Sequence):
    """Arrays (height, width) bool, written and read one at a time.

    Parameters
    ----------
    shapes : (height, width) of each
        They begin as False.
    """

    def __init__(self, shapes: list[tuple[int, ...]]):
        self._shapes = shapes
        self._bits = [np.zeros(-(-int(np.prod(shape)) // 8), dtype=np.uint8) for shape in shapes]

    def __len__(self) -> int:
        return len(self._bits)

    def __getitem__(self, number):
        """The mask of a number."""
        shape = self._shapes[number]
        return np.unpackbits(self._bits[number], count=int(np.prod(shape))).reshape(shape).view(bool)

    def __setitem__(self, number: int, mask: np.ndarray) -> None:
        self._bits[number] = np.packbits(mask)

    def add(self, number: int, mask: np.ndarray) -> None:
        """Set what a mask, of any shape with as many pixels, has."""
        self._bits[number] |= np.packbits(mask)

    def copy(self) -> Masks:
        """The same masks, to be changed without these."""
        other = Masks([])
        other._shapes, other._bits = list(self._shapes), [bits.copy() for bits in self._bits]
        return other
