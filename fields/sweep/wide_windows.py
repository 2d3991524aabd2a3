"""Heights of the bed that only two photographs show, from windows wider than ripples.

Ripples move between two exposures: windows of some pixels match them, at heights of their own above or below the bed,
and no third photograph contradicts. The texture of the bed is coarser. In wide windows of reduced photographs it
outweighs theirs. The error that ripples leave in a height varies from window to window: it shows in the differences of
heights and averages out in their mean.
"""

from collections.abc import Collection
from dataclasses import replace

import cv2
import numpy as np

from fields.sweep.block import Block
from fields.sweep.fusion import PEERS
from fields.sweep.maps import HeightMap, OrderedMaps, StoreFactory, small_sample_factor, trusted, upsample_map
from fields.sweep.matching import Pass
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import Area, SweepSettings

# The widest windows that there are kernels for, at a quarter of the size: the first pass tries all heights, the last
# resolves them.
_SCALE, _RADIUS = 0.25, 8
_PASSES = (
    Pass(_SCALE, _RADIUS, None, 0.5, 1, False),
    Pass(_SCALE, _RADIUS, 7, 0.125, 1, False),
    Pass(_SCALE, _RADIUS, 7, 0.05, 1, True),
)
# Means over the area of a reduced pixel leave ripples of its size, as false coarser ones: photographs are smoothed
# before by this standard deviation [px], three quarters of a reduced pixel.
_SMOOTH_PX = 0.75 / _SCALE
_LEAST_KNOWN = 0.5
# Heights are averaged over as much as a window: a Gauss filter of this standard deviation [px at that scale].
_SIDE, _MEAN_PX = 2 * _RADIUS + 1, float(_RADIUS)
# Heights further from the mean than so many standard deviations of it count no longer; the mean is taken again.
_OUTLYING, _ROUNDS = 3.0, 3
# Error of matching that neighbouring windows share (interpolation, rims on slopes), one standard deviation [reduced
# px]: 0.01 to 0.035 on drawn pairs with ripples (tests/rippled_pair.py).
_ALIKE_PX = 0.03
_SECOND_DIFFERENCE = 6.0  # Variance of a second difference of three values without correlation, over that of each


def wet_pairs(block: Block, views: Collection[int]) -> list[int]:
    """Views of water that overlap with a single other one."""
    if block.water is None:
        return []
    return [view for view in views if len(block.neighbours(view, PEERS)) == 1]


def with_wide_windows(
    block: Block, maps: OrderedMaps, bound: tuple[float, float], area: Area | None, make_store: StoreFactory = dict
) -> OrderedMaps:
    """Maps whose heights under water, where only two photographs show a place, are means of wide windows.

    A pixel that these find dry and the narrow ones wet confirms nothing. The maps are returned as they are where three
    photographs overlap, and in a dry survey. Parameters are those of `fields.sweep.sweep.sweep`.
    """
    pairs = wet_pairs(block, maps.views)
    if not pairs:
        return maps
    settings = SweepSettings(bound, _PASSES, area)
    wide = sweep(_smoothed(block), pairs, settings, lambda _share: None, make_store=make_store)
    found = make_store()
    for number, view in enumerate(maps.views):
        found[view] = maps[number]
    for number, view in enumerate(wide.views):
        others = block.neighbours(view, PEERS)
        alike_m = _ALIKE_PX / (_SCALE * block.parallax(view, others, block.height))
        found[view] = _merged(found[view], averaged(wide[number], alike_m))
    return OrderedMaps(found, maps.views)


def _smoothed(block: Block) -> Block:
    """The block with photographs smoothed by `_SMOOTH_PX`."""

    def smooth(image: np.ndarray) -> np.ndarray:
        image = np.asarray(image, dtype=np.float32)
        known = np.isfinite(image)
        values, share = (_gaussian(each, _SMOOTH_PX) for each in (np.where(known, image, 0.0), known))
        return np.where(known & (share > _LEAST_KNOWN), values / np.maximum(share, 1e-6), np.float32(np.nan))

    images = (smooth(block.images[view]) for view in range(len(block.cameras)))
    return Block(block.device, block.cameras, images, block.water, block.height)


def _merged(narrow: HeightMap, wide: HeightMap) -> HeightMap:
    """The narrow map with the heights of the wide one where that is under water."""
    wide = upsample_map(wide, narrow.height.shape[::-1])
    wet = wide.height < 0.0
    merged = {
        name: np.where(wet, getattr(wide, name), getattr(narrow, name))
        for name in ("height", "score", "agreeing", "spread")
    }
    merged["agreeing"][~wet & (narrow.height < 0.0)] = 0
    return replace(narrow, **merged)


def averaged(m: HeightMap, alike_m: float = 0.0) -> HeightMap:
    """Map of wide windows with heights averaged over as much as a window, and the spread that their std asks for.

    ``alike_m`` [m] is the standard deviation that windows beside each other share.
    """
    std, is_trusted = window_std(m), trusted(m)
    weight, mean = is_trusted.astype(np.float32), m.height
    for _ in range(_ROUNDS):
        count = _gaussian(weight, _MEAN_PX)
        mean = np.where(count > 1e-3, _gaussian(weight * m.height, _MEAN_PX) / np.maximum(count, 1e-3), m.height)
        weight = (is_trusted & (np.abs(m.height - mean) < _OUTLYING * std)).astype(np.float32)
    # Windows share pixels: a mean over an area of 4 pi s^2 has 1 + 4 pi s^2 / side^2 independent values.
    std = np.hypot(std / np.sqrt(1.0 + 4.0 * np.pi * _MEAN_PX**2 / _SIDE**2), alike_m)
    # The spread of which `fields.sweep.maps.height_std` makes this standard deviation again.
    spread = std / np.sqrt(small_sample_factor(np.array(2.0)))
    return replace(m, height=mean.astype(np.float32), spread=spread.astype(np.float16))


def window_std(m: HeightMap) -> np.ndarray:
    """Standard deviation (height, width) [m] of the heights of windows, by those beside it that share no pixel.

    From second differences of heights a window apart, around each pixel: by ripples, and by relief that is no plane
    over three windows.
    """
    size, known = m.height.shape, trusted(m).astype(np.float32)
    total, weight = np.zeros(size, np.float32), np.zeros(size, np.float32)
    for axis in (0, 1):
        if size[axis] <= 2 * _SIDE:
            continue
        before, centre, after = (
            np.moveaxis(np.stack([m.height, known]), axis + 1, 1)[:, each]
            for each in (np.s_[: -2 * _SIDE], np.s_[_SIDE:-_SIDE], np.s_[2 * _SIDE :])
        )
        all_known = before[1] * centre[1] * after[1]
        bend = before[0] - 2.0 * centre[0] + after[0]
        for target, values in ((total, all_known * bend * bend), (weight, all_known)):
            np.moveaxis(target, axis, 0)[_SIDE:-_SIDE] += values
    near, count = (_gaussian(each, _SIDE) for each in (total, weight))
    # Where no window has two beside it, what all the others say.
    everywhere = total.sum() / max(float(weight.sum()), 1.0)
    mean = np.where(count > 1e-3, near / np.maximum(count, 1e-3), everywhere)
    return np.sqrt(mean / _SECOND_DIFFERENCE)


def _gaussian(values: np.ndarray, std_px: float) -> np.ndarray:
    return cv2.GaussianBlur(values.astype(np.float32), (0, 0), std_px, borderType=cv2.BORDER_REFLECT)
