"""Photographs in tiles of several scales, as JPEG, for a page that shows what it is looked at of them."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from survey.errors import ImageError
from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb

TILE_PX = 512
_QUALITY = 92
# Of decoded photographs that are kept: some of 45 megapixels, hundreds of small ones.
_KEPT_BYTES = 600e6


class Tiles:
    """Tiles of photographs, of which the last ones are kept decoded; for several threads.

    Level 0 has the pixels of the file; each further level has half as many along each side, every pixel of it the mean
    of four of the level before, so that pixel x of level k begins at ``2**k * x``.
    """

    def __init__(self, images: Mapping[str, Path]):
        self._images = images
        self._kept: OrderedDict[str, list[np.ndarray]] = OrderedDict()
        self._lock = threading.Lock()
        self._decoding: dict[str, threading.Lock] = {}

    def jpeg(self, image: str, level: int, column: int, row: int) -> bytes:
        """A tile of at most `TILE_PX` pixels along each side.

        Raises
        ------
        ImageError
            If there is no such tile, or the photograph cannot be read.
        """
        levels = self._levels(image)
        left, top = column * TILE_PX, row * TILE_PX
        is_there = 0 <= level < len(levels) and left >= 0 and top >= 0
        part = levels[level][top : top + TILE_PX, left : left + TILE_PX] if is_there else np.zeros((0, 0, 3))
        if not part.size:
            raise ImageError(f"{image} has no tile {column}, {row} at level {level}")
        _, packed = cv2.imencode(".jpg", cv2.cvtColor(part, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
        return packed.tobytes()

    def _levels(self, image: str) -> list[np.ndarray]:
        if image not in self._images:
            raise ImageError(f"there is no photograph {image[:60]}")
        with self._lock:
            decoding = self._decoding.setdefault(image, threading.Lock())
        # One thread decodes a photograph while others go on with those that are there.
        with decoding:
            levels = self._kept.get(image)
            if levels is None:
                levels = pyramid(eight_bits(read_rgb(self._images[image])))
            self._keep(image, levels)
        return levels

    def _keep(self, image: str, levels: list[np.ndarray]) -> None:
        """As the last one of those that are kept."""
        with self._lock:
            self._kept[image] = levels
            self._kept.move_to_end(image)
            while len(self._kept) > 1 and self._bytes() > _KEPT_BYTES:
                self._kept.popitem(last=False)

    def _bytes(self) -> int:
        return sum(level.nbytes for levels in self._kept.values() for level in levels)


def pyramid(pixels: np.ndarray) -> list[np.ndarray]:
    """A photograph (height, width, 3) uint8 and its halves, down to one that is a tile."""
    levels = [pixels]
    while max(levels[-1].shape[:2]) > TILE_PX:
        height, width = levels[-1].shape[:2]
        even = cv2.copyMakeBorder(levels[-1], 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        levels.append(cv2.resize(even, (even.shape[1] // 2, even.shape[0] // 2), interpolation=cv2.INTER_AREA))
    return levels
