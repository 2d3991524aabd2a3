"""Compact storage of the images and masks of many views, and the gamma of stored grey levels."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from torch import Tensor

_KEPT_BYTES, _FEWEST_KEPT = 30_000_000, 2  # Images in float32 that are kept, in bytes, or so many
GAMMA = 2.2  # sRGB-like photographs are linear in light to the power of 2.2
DARKEST = 1e-4  # Clamp, darker than any photograph resolves: below it the derivative of the gamma curve diverges


class LazyImages(Sequence):
    """Images (height, width) float32 of one size, computed when they are read; read-only.

    ``make``: the image of a number. ``count``: number of images. ``shape`` (height, width). ``most``: how many are
    kept, those that were read last; default 100 MB, but two at least.
    """

    def __init__(self, make: Callable[[int], np.ndarray], count: int, shape: tuple[int, ...], most: int | None = None):
        most = num_cached(4 * int(np.prod(shape)), _KEPT_BYTES, _FEWEST_KEPT) if most is None else most
        self.shape, self._count = shape, count
        self._made = lru_cache(most)(make)

    def __len__(self) -> int:
        return self._count

    def __getitem__(self, number):
        if not 0 <= number < self._count:
            raise IndexError(f"there are {self._count} images, got number {number}")
        return self._made(number)


def num_cached(num_bytes: int, budget: int, fewest: int) -> int:
    """Number of arrays of a size in bytes that a budget holds, at least ``fewest``."""
    return max(budget // max(num_bytes, 1), fewest)


class GreyImages(LazyImages):
    """Grey images (height, width) float32, NaN where masked; read-only, one byte a pixel where levels are whole.

    ``images``: arrays (height, width), of one size; read once, so that a generator need not hold all of them.
    ``store_array``: stores an array (height, width) where it takes no memory; what it returns has the shape and gives
    parts of the array by slices of rows and columns. Default: in memory. ``of_one_size``: whether other sizes are
    refused.
    """

    def __init__(
        self,
        images: Iterable[np.ndarray],
        store_array: Callable[[np.ndarray], Any] | None = None,
        *,
        of_one_size: bool = True,
    ):
        kept = [_stored(image, store_array or (lambda array: array)) for image in images]
        shapes = {each[0].shape for each in kept}
        if of_one_size and len(shapes) > 1:
            raise ValueError(f"expected images of one size, got {sorted(shapes)}")
        self._hold(kept)

    def _hold(self, kept: list[tuple[Any, Any, bool]]) -> None:
        self._kept = kept
        largest = tuple(max(sides) for sides in zip(*(each[0].shape for each in kept), strict=True)) or (0, 0)
        super().__init__(lambda view: _window(kept[view], slice(None), slice(None), write=False), len(kept), largest)

    def __getstate__(self) -> list[tuple[Any, Any, bool]]:
        """State for pickling: images kept in files are pickled by path, without pixels."""
        return self._kept

    def __setstate__(self, kept: list[tuple[Any, Any, bool]]) -> None:
        self._hold(kept)

    def window(self, view: int, rows: slice, columns: slice) -> np.ndarray:
        return _window(self._kept[view], rows, columns)

    def is_masked(self, view: int) -> bool:
        """Whether any pixel of an image is masked."""
        return self._kept[view][2]

    @property
    def are_unmasked(self) -> bool:
        """Whether no pixel is masked."""
        return not any(is_masked for _, _, is_masked in self._kept)


def _stored(image: np.ndarray, store_array: Callable[[np.ndarray], Any]) -> tuple[Any, Any, bool]:
    """Levels of a grey image, bits of its mask, and whether it has one: int8 where that loses nothing, or float32."""
    levels = np.asarray(image, dtype=np.float32)
    masked = np.isnan(levels)
    is_masked = bool(masked.any())
    known = np.where(masked, np.float32(0.0), levels) if is_masked else levels
    if known.min() < -128.0 or known.max() > 127.0 or not np.array_equal(small := known.astype(np.int8), known):
        return store_array(levels), None, is_masked
    return store_array(small), store_array(np.packbits(masked, axis=1)) if is_masked else None, is_masked


def _window(of: tuple[Any, Any, bool], rows: slice, columns: slice, *, write: bool = True) -> np.ndarray:
    levels, masked, _ = of
    image = levels[rows, columns].astype(np.float32)
    if masked is not None:
        bits = np.unpackbits(masked[rows, :], axis=1, count=levels.shape[1])
        image[bits[:, columns].view(bool)] = np.nan
    image.flags.writeable = write
    return image


class Masks(Sequence):
    """Masks (height, width) bool of many images, one bit a pixel.

    ``shapes`` (height, width) of each: they begin as False.
    """

    def __init__(self, shapes: list[tuple[int, ...]]):
        self._shapes = shapes
        self._bits = [np.zeros(-(-int(np.prod(shape)) // 8), dtype=np.uint8) for shape in shapes]

    def __len__(self) -> int:
        return len(self._bits)

    def __getitem__(self, number):
        shape = self._shapes[number]
        return np.unpackbits(self._bits[number], count=int(np.prod(shape))).reshape(shape).view(bool)

    def __setitem__(self, number: int, mask: np.ndarray) -> None:
        self._bits[number] = np.packbits(mask)

    def add(self, number: int, mask: np.ndarray) -> None:
        """Union with a mask of any shape with as many pixels."""
        self._bits[number] |= np.packbits(mask)

    def copy(self) -> Masks:
        """Deep copy."""
        other = Masks([])
        other._shapes, other._bits = list(self._shapes), [bits.copy() for bits in self._bits]
        return other


def as_stored(radiance: Tensor) -> Tensor:
    """Stored values, 0 to 1 (more where overexposed), of linear radiance, which is clamped to `DARKEST`."""
    return radiance.clamp(min=DARKEST) ** (1.0 / GAMMA)
