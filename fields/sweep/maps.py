"""Height maps of many views, their stores and containers, and which heights are trusted.

Maps in memory take 9 bytes a pixel, so that those of a large survey do not fit. The caller may provide stores on the
disk; only maps in work are read.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import cv2
import numpy as np

from fields.image_store import LruCache
from refract import FlatWater, PinholeCamera

Kind = TypeVar("Kind")
# A height confirmed by two other views is trusted; confirmed by one, only where the images also correlate this well.
CONFIRMED_TWICE = 2
TRUSTED_NCC = 0.8


@dataclass
class HeightMap:
    """Height map of one view: arrays (height, width), local frame."""

    view: int  # index of the view
    height: np.ndarray  # float32 [m]: over the water plane along its normal; of the path of each pixel
    score: np.ndarray  # float16: NCC of the better half of the neighbours, -1 to 1
    agreeing: np.ndarray  # uint8: other views whose own height agrees
    spread: np.ndarray  # float16 [m]: standard deviation (population) of the heights that agree, the own one included


# Store of maps by view: a dict, or one on the disk. A map that was changed has to be stored again.
Maps = MutableMapping[int, HeightMap]
# Factory of empty stores.
Keep = Callable[[], Maps]


class OrderedMaps(Sequence):
    """Sequence of maps in the order of given views, each read when it is asked for.

    Attributes
    ----------
    views : list of int
    """

    def __init__(self, maps: MutableMapping[int, Any], views: list[int]):
        self._maps, self.views = maps, views

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, number):
        """The map of the view at a place in the order."""
        return self._maps[self.views[number]]

    def clear(self) -> None:
        """Remove all maps."""
        self.views = []
        self._maps.clear()


class ByView(Mapping[int, Kind]):
    """Mapping of views to maps, or to values per map, from a sequence."""

    def __init__(self, maps: Sequence[Kind] | LruCache[int, Kind], views: list[int]):
        self._maps = maps
        self._number = {view: number for number, view in enumerate(views)}

    def __getitem__(self, view: int) -> Kind:
        return self._maps[self._number[view]]

    def __iter__(self) -> Iterator[int]:
        return iter(self._number)

    def __len__(self) -> int:
        return len(self._number)

    def __contains__(self, view: object) -> bool:
        return view in self._number


def trusted(height_map: HeightMap) -> np.ndarray:
    """Pixels (height, width) bool of a map whose height other views confirm."""
    return confirmed(height_map, TRUSTED_NCC)


def confirmed(height_map: HeightMap, least_ncc: float) -> np.ndarray:
    """Pixels that two other views confirm, or one where the score is above a value."""
    once = (height_map.agreeing == 1) & (height_map.score > least_ncc)
    return (height_map.agreeing >= CONFIRMED_TWICE) | once


def upsample_map(m: HeightMap, size: tuple[int, int]) -> HeightMap:
    """Map upsampled to a size (width, height)."""
    if m.height.shape == size[::-1]:
        return m
    height, score, spread = (
        cv2.resize(each.astype(np.float32), size, interpolation=cv2.INTER_LINEAR).astype(each.dtype)
        for each in (m.height, m.score, m.spread)
    )
    agreeing = cv2.resize(m.agreeing, size, interpolation=cv2.INTER_NEAREST)
    return HeightMap(m.view, height, score, agreeing, spread)


@dataclass
class Sources:
    """Photographs with a height map: one entry per matched view."""

    cameras: list[PinholeCamera]
    maps: Sequence[HeightMap]
    images: list[np.ndarray]  # list of (height, width, 3) uint8
    water: FlatWater | None
    # absorption, veil (3,) floats, optional: of the water, where they are known; see `fields.water_column.WaterColumn`
    absorption: tuple[float, ...] | None = None
    veil: tuple[float, ...] | None = None

    @cached_property
    def pixels(self) -> list[np.ndarray]:
        """Flat indices of the trusted pixels of each map, inside its image."""
        found = []
        for camera, height_map in zip(self.cameras, self.maps, strict=True):
            keep = trusted(height_map)
            keep[camera.height :], keep[:, camera.width :] = False, False
            found.append(np.flatnonzero(keep))
        return found
