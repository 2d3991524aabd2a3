"""Images packed so that one lookup brings all that lies between four pixels.

A word holds the grey levels of a pixel and of its neighbours to the right, below, and below to the right, as whole
numbers of steps over a lowest level. Bilinear interpolation then takes one lookup instead of four, which are what
sampling costs most. Images of whole levels that span fewer than 256 and have no masked pixel take 8 bits a level and
lose nothing. Others take 16: a step is then a power of two, at most 2^-15 of what the levels span: means of
four or sixteen pixels of a photograph lose nothing either.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from fields.device import Device, memory_bytes
from fields.sweep.arrays import words
from fields.sweep.lazy import most_kept
from fields.sweep.recent import Recent

# The first level of a word of 16 bits a level where any of its four pixels is masked.
MASKED = 2**16 - 1
# Packed images that are kept on a processor, in bytes, or so many: a view's neighbours and those of the next.
KEPT_BYTES, FEWEST_KEPT = 200_000_000, 20
# Share of the memory of a device that is apart: height maps take half of it.
_OF_MEMORY = 0.25
# Levels that span less are taken to span so much.
LEAST_SPAN = 1e-3


@dataclass(frozen=True)
class Quads:
    """Images of one size, packed.

    Attributes
    ----------
    values : (height * width) words of the device, by the number of the image; the last few are kept
    bits : of a level in a word, 8 or 16
    low, step : of the levels, ``low + step * whole``
    """

    values: Recent[int, Any]
    bits: int
    low: float
    step: float

    @staticmethod
    def build(device: Device, images: Sequence[np.ndarray]) -> Quads:
        """Pack images (height, width) float32 of one size, each when it is needed; NaN is masked."""
        least, most, are_whole = np.inf, -np.inf, True
        for image in images:
            if not np.isnan(image).all():
                least, most = min(least, float(np.nanmin(image))), max(most, float(np.nanmax(image)))
            are_whole = are_whole and np.array_equal(np.rint(image), image)
        least, most = (0.0, 0.0) if most < least else (least, most)
        bits = 8 if most - least < 2**8 and are_whole else 16
        step = 1.0 if bits == 8 else 2.0 ** np.ceil(np.log2(max(most - least, LEAST_SPAN) / (MASKED - 2)))
        low = step * np.floor(least / step)
        size = images[0].size * bits // 2
        budget = max(int(_OF_MEMORY * memory_bytes(device)), KEPT_BYTES)
        kept = most_kept(size, budget, FEWEST_KEPT)
        values: Recent[int, Any] = Recent(lambda view: words(device, _packed(images[view], low, step, bits)), kept)
        return Quads(values, bits, float(low), float(step))


def _packed(image: np.ndarray, low: float, step: float, bits: int) -> np.ndarray:
    """The words (height, width) of one image; the last row and column are neighbours of themselves."""
    if bits == 8:
        return _words((image - np.float32(low)).astype(np.uint8), np.uint32)
    masked = np.isnan(image)
    levels = np.where(masked, np.float32(low), image).astype(np.float64)
    levels -= low
    levels /= step
    target = _words(np.rint(levels, out=levels).clip(min=0.0, out=levels).astype(np.uint16), np.uint64)
    if masked.any():
        four = _four(masked.astype(np.uint8))
        target.view(np.uint16)[..., ::4][(four[0] | four[1] | four[2] | four[3]).view(bool)] = MASKED
    return target


def _words(levels: np.ndarray, word: type) -> np.ndarray:
    """Four levels a word."""
    return cv2.merge(_four(levels)).view(word)[..., 0]


def _four(image: np.ndarray) -> list[np.ndarray]:
    """An image, and what lies to the right of, below, and below to the right of each pixel."""
    image = cv2.copyMakeBorder(image, 0, 1, 0, 1, cv2.BORDER_REPLICATE)
    return [image[:-1, :-1], image[:-1, 1:], image[1:, :-1], image[1:, 1:]]
