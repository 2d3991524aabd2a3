"""Recipes of qualities, the size of photographs in a run, what a pixel covers at it, and the limits that a cloud has to
meet.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from evaluation.standards import TO_95, TVU
from survey.folder.survey import Survey
from survey.plan.area import flattened
from survey.plan.choices import USUAL, Choices
from survey.plan.heights import dry_ground
from survey.words import Quality

# Of the standard deviation that points have of their own, in ground sampling distances.
MAX_STD_GSD = 1.5
# Of the standard deviation of a height with all that it shares: that of IHO S-44's strictest order in shallow water,
# 77 mm, where one and a half ground sampling distances are less.
STRICTEST_ORDER_M = TVU[0][1] / TO_95
# Least share of the photographs that is not white: with less, no number of them shows the bed.
_LEAST_CLEAR_SHARE = 0.1


@dataclass(frozen=True)
class Recipe:
    """Numeric settings of a quality."""

    megapixels: float  # [Mpx]: largest image to process; larger ones are halved until they fit
    # (int, int): how often every place is to be seen by views with a height map of their own: by steep ones, and by
    # oblique ones from each quarter. Three confirm each other; docs/sweep.md has the gain from more.
    times_seen: tuple[int, int]
    field: str  # "solver" or "off": what refines the heights of the sweep
    rays_per_cell: float = 14.0  # Rays that a trained field learns from, per cell of one ground sampling distance


RECIPES = {
    Quality.draft.value: Recipe(megapixels=2.0, times_seen=(4, 1), field="off"),
    Quality.standard.value: Recipe(megapixels=6.0, times_seen=(4, 4), field="solver"),
    # More than any place is seen: every view is matched.
    Quality.fine.value: Recipe(megapixels=100.0, times_seen=(1000, 1000), field="solver"),
}


def required_views(white_shares: Sequence[float], times_seen: tuple[int, int]) -> tuple[int, int]:
    """Number of photographs, as `Recipe.times_seen`: more where shares of them are white, which show no bed."""
    clear = max(1.0 - sum(white_shares) / max(len(white_shares), 1), _LEAST_CLEAR_SHARE)
    steep, oblique = (round(times / clear) for times in times_seen)
    return steep, oblique


def image_scale(width: int, height: int, megapixels: float) -> float:
    """Scale [-], at most 1, that reduces an image of a size [px] to a limit [px]."""
    halvings = math.ceil(0.5 * math.log2(width * height / (1e6 * megapixels)) - 1e-9)
    return 0.5 ** max(halvings, 0)


def max_height_std(gsd_m: float) -> float:
    """Largest standard deviation [m] of a height, all included, at a ground sampling distance [m]."""
    return max(MAX_STD_GSD * gsd_m, STRICTEST_ORDER_M)


def image_scale_of(survey: Survey, chosen: Choices = USUAL) -> float:
    """Scale [-] of the photographs in a run, at most 1."""
    if chosen.image_scale is not None:
        return chosen.image_scale
    megapixels = RECIPES[chosen.quality].megapixels
    return min(image_scale(view.camera.width, view.camera.height, megapixels) for view in survey.views)


def gsd_m(survey: Survey, chosen: Choices = USUAL) -> float:
    """Ground sampling distance [m] at that scale, median over the views: at the water, or dry ground."""
    survey = flattened(survey)
    height = camera_height_m(survey)
    sizes = []
    for camera in (view.camera for view in survey.views):
        own = height if survey.water is None else -float(survey.water.depth(camera.centre))
        # Along its axis, at most three heights.
        sizes.append(own / max(-camera.cam_from_local[2, 2], 1.0 / 3.0) / camera.fx)
    return float(np.median(sizes)) / image_scale_of(survey, chosen)


def camera_height_m(survey: Survey) -> float:
    """Height [m] of the cameras over the water or ground, median."""
    centres = np.array([view.camera.centre for view in survey.views])
    if survey.water is not None:
        return float(np.median(-survey.water.depth(centres)))
    return float(np.median(centres[:, 2])) - dry_ground(survey).height
