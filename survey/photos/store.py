"""Photographs that several stages of a run use, decoded once."""

from __future__ import annotations

import numpy as np

from survey import machine
from survey.photos.cameras import View
from survey.photos.images import eight_bits, grey_levels, load_pixels

# Of the memory that is free when a store is made, and at most: decoding once more costs 15 ms a megapixel.
_SHARE_OF_FREE, _MOST_BYTES = 0.25, 100_000_000


class ImageStore:
    """`survey.photos.images.load_image` with a cache of bounded memory.

    Stages read the photographs in the same order, so that the first images that fit are kept: evicting the least
    recently used one would evict each image just before it is used again.

    Parameters
    ----------
    budget_bytes : int, optional
        Memory for kept images; default a quarter of the free memory, at most 100 MB.
    """

    def __init__(self, budget_bytes: int | None = None):
        if budget_bytes is None:
            budget_bytes = min(int(_SHARE_OF_FREE * machine.free_memory_bytes()), _MOST_BYTES)
        self._left = budget_bytes
        self._images: dict[tuple, np.ndarray] = {}

    def load(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The photograph (height, width, 3) uint8, RGB, not to be written to; see `load_image`.

        Raises
        ------
        ImageError
            As `load_image`.
        """
        image = eight_bits(self._pixels(view, scale))
        image.flags.writeable = False
        return image

    def grey(self, view: View, *, scale: float = 1.0) -> np.ndarray:
        """The brightness (height, width) float32 of the photograph, 0 to 255, with the depth of its file.

        Raises
        ------
        ImageError
            As `load_image`.
        """
        return grey_levels(self._pixels(view, scale))

    def _pixels(self, view: View, scale: float) -> np.ndarray:
        key = (view.path, view.lens, scale)
        if key in self._images:
            return self._images[key]
        image = load_pixels(view, scale=scale)
        if image.nbytes <= self._left:
            self._left -= image.nbytes
            self._images[key] = image
        return image
