"""Images that are made when they are read: from bytes, from larger images, from files; few are held at a time."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from fields.sweep.recent import Recent

# Images in float32 that are kept, in bytes, or so many.
_KEPT_BYTES, _FEWEST_KEPT = 30_000_000, 2


class Lazy(Sequence):
    """Images (height, width) float32 of one size, not to be written to.

    Parameters
    ----------
    make : the image of a number
    count : number of images
    shape : (height, width)
    most : how many are kept, those that were read last; default 100 MB, but two at least
    """

    def __init__(self, make: Callable[[int], np.ndarray], count: int, shape: tuple[int, ...], most: int | None = None):
        most = most_kept(4 * int(np.prod(shape)), _KEPT_BYTES, _FEWEST_KEPT) if most is None else most
        self.shape, self._count = shape, count
        self._made: Recent[int, np.ndarray] = Recent(make, most)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number):
        """The image of a number."""
        if not 0 <= number < self._count:
            raise IndexError(f"there are {self._count} images, got number {number}")
        return self._made[number]


def most_kept(num_bytes: int, budget: int, fewest: int) -> int:
    """How many arrays of so many bytes a budget holds, but not fewer than ``fewest``."""
    return max(budget // max(num_bytes, 1), fewest)
