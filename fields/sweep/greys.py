"""Grey images in little memory: whole levels take a byte each. Read one at a time, as float32."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from fields.sweep.lazy import Lazy


class Greys(Lazy):
    """Images (height, width) float32, NaN where masked, not to be written to.

    Parameters
    ----------
    images : arrays (height, width)
        Of one size; read once, so that a generator need not hold all of them.
    """

    def __init__(self, images: Iterable[np.ndarray]):
        self._kept = kept = [_Kept(image) for image in images]
        shapes = {each.levels.shape for each in self._kept}
        if len(shapes) > 1:
            raise ValueError(f"expected images of one size, got {sorted(shapes)}")
        super().__init__(lambda view: kept[view].whole(), len(self._kept), next(iter(shapes), (0, 0)))

    def window(self, view: int, rows: slice, columns: slice) -> np.ndarray:
        """A part of an image, without the rest of it."""
        return self._kept[view].window(rows, columns)

    @property
    def are_whole(self) -> bool:
        """Whether no pixel is masked."""
        return not any(each.is_masked for each in self._kept)


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
            self.levels, self.masked = small, np.packbits(masked, axis=1) if self.is_masked else None

    def whole(self) -> np.ndarray:
        """As it came."""
        image = self.window(slice(None), slice(None))
        image.flags.writeable = False
        return image

    def window(self, rows: slice, columns: slice) -> np.ndarray:
        """A part of it."""
        image = self.levels[rows, columns].astype(np.float32)
        if self.masked is not None:
            bits = np.unpackbits(self.masked[rows], axis=1, count=self.levels.shape[1])
            image[bits[:, columns].view(bool)] = np.nan
        return image
