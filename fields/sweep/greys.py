"""Grey images in little memory: whole levels take a byte each. Read one at a time, as float32."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from fields.sweep.recent import Recent

# Images kept as float32: a view and those that it is compared with.
_READ = 24


class Greys(Sequence):
    """Images (height, width) float32, NaN where masked, not to be written to.

    Parameters
    ----------
    images : arrays (height, width)
        Read once, so that a generator need not hold all of them.
    """

    def __init__(self, images: Iterable[np.ndarray]):
        self._kept = [_Kept(image) for image in images]
        self._read: Recent[int, np.ndarray] = Recent(lambda view: self._kept[view].whole(), _READ)

    def __len__(self) -> int:
        return len(self._kept)

    def __getitem__(self, view):
        """The image of a view."""
        if not 0 <= view < len(self):
            raise IndexError(f"there are {len(self)} images, got number {view}")
        return self._read[view]

    @property
    def are_whole(self) -> bool:
        """Whether no pixel is masked."""
        return not any(each.is_masked for each in self._kept)

    def shape(self, view: int) -> tuple[int, ...]:
        """Height and width of an image."""
        return self._kept[view].levels.shape


class _Kept:
    """One image: its levels as int8 and a mask where that loses nothing, as float32 otherwise."""

    def __init__(self, image: np.ndarray):
        levels = np.asarray(image, dtype=np.float32)
        masked = np.isnan(levels)
        self.is_masked = bool(masked.any())
        self.levels: np.ndarray = levels
        self.masked: np.ndarray | None = None
        known = np.where(masked, np.float32(0.0), levels) if self.is_masked else levels
        if known.min() >= -128.0 and known.max() <= 127.0 and np.array_equal(small := known.astype(np.int8), known):
            self.levels, self.masked = small, np.packbits(masked) if self.is_masked else None

    def whole(self) -> np.ndarray:
        """As it came."""
        image = self.levels.astype(np.float32)
        if self.masked is not None:
            image[np.unpackbits(self.masked, count=image.size).reshape(image.shape).view(bool)] = np.nan
        image.flags.writeable = False
        return image
