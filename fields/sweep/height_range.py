"""Height range of the bed from a full sweep of a few views at thumbnail size."""

from __future__ import annotations

import cv2
import numpy as np
from scipy import ndimage

from fields.sweep.block import Block
from fields.sweep.kernels.backend import run_job
from fields.sweep.kernels.stack import Hypotheses
from fields.sweep.matching import Reference, match_with_adaptive_windows

THUMBNAIL_PX = 128
NUM_VIEWS = 8
NUM_NEIGHBOURS = 8
WINDOW_RADIUS = 3
# A thumbnail pixel counts where half of its neighbours correlate this well in such windows, and the best height is not
# the first or the last hypothesis. In wider windows the threshold falls in proportion to chance correlation.
CONFIDENT_NCC = 0.7
MIN_PIXELS = 200
# With fewer height hypotheses, of which the first and the last count for nothing, a range is narrow already.
_FEWEST_HYPOTHESES = 9
# Chance matches are uniform between the limits. Of so many bins, those with less than this share of the mean count hold
# chance matches alone; bins with more than that, by so many standard deviations, hold bed, and so do bins connected to
# them, such as a mast.
_PARTS, _CHANCE, _SIGMAS = 60, 0.25, 4.0


def find_range(block: Block, limits: tuple[float, float]) -> tuple[float, float]:
    """Heights [m] over the water plane between which the bed lies.

    Raises ValueError if too few pixels match.

    Parameters
    ----------
    limits : (low, high) [m]
        Range of heights searched.

    Returns
    -------
    (low, high) [m]
        The 0.5 and 99.5 % quantiles of the heights that match well and continue around, without those that are no
        more frequent than chance, widened by a quarter of their distance and one step. The limits themselves, where
        thumbnails resolve too few heights between them.
    """
    scale = min(1.0, THUMBNAIL_PX / block.cameras[0].width)
    stack = block.stack(scale)
    chosen = block.cover(1, 0)
    # Of a tile perhaps none: its windows hold heights at which no view shows it.
    chosen = [chosen[i] for i in np.unique(np.linspace(0, len(chosen) - 1, NUM_VIEWS).astype(int))] if chosen else []
    heights, steps, radius = [np.empty(0)], [0.0], WINDOW_RADIUS
    for view in chosen:
        others = block.neighbours(view, NUM_NEIGHBOURS)
        if not others:
            continue
        step = 0.5 / (scale * block.parallax(view, others, 0.5 * (limits[0] + limits[1])))
        count = int(np.ceil((limits[1] - limits[0]) / step)) + 1
        if count < _FEWEST_HYPOTHESES:
            block.release(scale)
            return limits
        start = np.full((stack.height, stack.width), limits[0], dtype=np.float32)
        reference = Reference(stack, view, others, radius)
        job = match_with_adaptive_windows(reference, Hypotheses(start, step, count))
        (z, score, curvature), radius = run_job(block.device, job)
        confident = CONFIDENT_NCC * (2 * WINDOW_RADIUS + 1) / (2 * radius + 1)
        # A chance match is isolated; the bed continues in the pixels around.
        supported = np.abs(z - cv2.medianBlur(z, 5)) < step
        heights.append(z[(score > confident) & (curvature > 0.0) & supported])
        steps.append(step)
    block.release(scale)
    matched = np.concatenate(heights)
    if matched.size < MIN_PIXELS:
        raise ValueError(
            f"only {matched.size} thumbnail pixels match between views at heights from {limits[0]:.1f} to "
            f"{limits[1]:.1f} m over the water; check that poses, water level and images belong together and that "
            "the bed shows texture"
        )
    low, high = np.quantile(without_chance_matches(matched, limits), [0.005, 0.995])
    margin = 0.25 * (high - low) + max(steps)
    return max(float(low - margin), limits[0]), min(float(high + margin), limits[1])


def without_chance_matches(found: np.ndarray, limits: tuple[float, float]) -> np.ndarray:
    """Heights (N,) [m] without those in isolated bins of the histogram that hold no more than chance."""
    count, edges = np.histogram(found, bins=_PARTS, range=limits)
    chance = count[count < _CHANCE * count.mean()]
    rate = float(chance.mean()) if len(chance) else 0.0
    groups, _ = ndimage.label(count > 0)
    bed = np.isin(groups, np.unique(groups[count > rate + _SIGMAS * np.sqrt(rate)]))
    return found[bed[np.clip(np.searchsorted(edges, found, side="right") - 1, 0, _PARTS - 1)]]
