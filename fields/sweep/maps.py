"""Height maps of many views, their stores and containers, which heights are trusted, and their standard deviation.

Maps in memory take 9 bytes a pixel, so that those of a large survey do not fit. The caller may provide stores on the
disk; only maps in work are read.
"""

from collections.abc import Callable, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from refract import FlatWater, PinholeCamera

# A height confirmed by two other views is trusted; confirmed by one, only where the images also correlate this well.
CONFIRMED_TWICE = 2
TRUSTED_NCC = 0.8
# Disagreement and second differences are averaged by a Gauss filter of this standard deviation and width [px].
_LOCAL_STD_PX, _LOCAL_PX = 2.0, 17
_NEAR_PX = 5  # Views that agree within this distance of a pixel see it, too [px]
# Second differences are those of smoothed heights, over the width of the last windows [px].
_AVERAGED_PX, _AVERAGE_PX, _WIDTH_PX = 1.0, 9, 2


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
StoreFactory = Callable[[], Maps]  # Factory of empty stores


class MemoryBudget:
    """Memory budget that several stores share. ``left``: bytes that are not taken."""

    def __init__(self, num_bytes: int):
        self.left = num_bytes


class OrderedMaps(Sequence):
    """Sequence of maps in the order of given views, each read when it is asked for. ``views``: list of int."""

    def __init__(self, maps: MutableMapping[int, Any], views: list[int]):
        self._maps, self.views = maps, views

    def __len__(self) -> int:
        return len(self.views)

    def __getitem__(self, number):
        """The map of the view at a place in the order."""
        return self._maps[self.views[number]]

    def clear(self) -> None:
        self.views = []
        self._maps.clear()


def views_of(maps: Sequence[HeightMap]) -> list[int]:
    """Views of maps in their order; those on the disk are not read where the sequence has a list ``views``."""
    known = getattr(maps, "views", None)
    return [m.view for m in maps] if known is None else list(known)


def trusted(height_map: HeightMap) -> np.ndarray:
    """Pixels (height, width) bool of a map whose height other views confirm."""
    return is_confirmed(height_map, TRUSTED_NCC)


def is_confirmed(height_map: HeightMap, least_ncc: float) -> np.ndarray:
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


def height_std(
    height: np.ndarray,
    agreeing: np.ndarray,
    spread: np.ndarray,
    tolerance: float,
    num_comparable: np.ndarray | None = None,
) -> np.ndarray:
    """Standard deviation (height, width) [m] of the heights of a `HeightMap`, where other views confirm them.

    The variance has two estimates: that of a mean of heights, from their disagreement around the pixel (with waves and
    errors of the poses as far as views disagree by them); and the squared second differences of the map over the width
    of a window, which are its noise and the relief that windows flatten. Noise is in both: the larger one counts. Added
    is the disagreement of views that see another height there: they agree near the pixel, but not with it. ``height``,
    ``agreeing``, ``spread`` (height, width): as `HeightMap` has them. ``tolerance`` [m]: heights of views that differ
    by less agree. ``num_comparable`` (height, width), optional: number of views that may see another height there; by
    default all. A photograph that is masked or white there shows none (`fields.sweep.fusion.num_comparable`).
    """
    views = agreeing.astype(np.float32) + 1.0
    confirmed = views > 1.0
    # The spread is a population figure.
    squares = _local_mean(np.where(confirmed, views * spread.astype(np.float32) ** 2, 0.0))
    others = _local_mean(views - 1.0)
    disagreement = squares / np.maximum(others, 1e-6)
    dissenting = np.where(confirmed, cv2.dilate(views, np.ones((_NEAR_PX, _NEAR_PX))) - views, 0.0)
    if num_comparable is not None:
        dissenting = np.clip(num_comparable - agreeing, 0.0, dissenting)
    # A view that does not agree differs by the tolerance at least.
    with_dissenting = (squares + _local_mean(dissenting) * tolerance**2) / np.maximum(
        others + _local_mean(dissenting), 1e-6
    )
    dissent = np.maximum(with_dissenting - disagreement, 0.0)
    second_differences = _local_mean(np.where(confirmed, _squared_second_differences(height), 0.0)) / np.maximum(
        _local_mean(confirmed), 1e-6
    )
    return np.sqrt(
        small_sample_factor(views) * (np.maximum(disagreement / views, second_differences) + dissent / views)
    )


def small_sample_factor(views: np.ndarray) -> np.ndarray:
    """Variance factor of heights on which few photographs agree, by Student's distribution.

    Local effects (a reflection, an occluding edge) are known from those photographs alone: Student's distribution with
    one degree of freedom more than there are photographs.
    """
    count = np.maximum(views.astype(np.float32), 2.0)
    return (count + 1.0) / (count - 1.0)


def _local_mean(values: np.ndarray) -> np.ndarray:
    return _gaussian(values.astype(np.float32), _LOCAL_PX, _LOCAL_STD_PX)


def _squared_second_differences(height: np.ndarray) -> np.ndarray:
    """Mean square of the second differences of heights across and down, [m^2]."""
    smooth = _gaussian(height.astype(np.float32), _AVERAGE_PX, _AVERAGED_PX)
    kernel = np.zeros((1, 2 * _WIDTH_PX + 1), dtype=np.float32)
    kernel[0, [0, _WIDTH_PX, -1]] = 1.0, -2.0, 1.0
    across, down = (cv2.filter2D(smooth, -1, each, borderType=cv2.BORDER_REFLECT) for each in (kernel, kernel.T))
    return 0.5 * (across * across + down * down)


def _gaussian(values: np.ndarray, side: int, std_px: float) -> np.ndarray:
    return cv2.GaussianBlur(values, (side, side), std_px, borderType=cv2.BORDER_REFLECT)
