"""Recipes of qualities, the working size of photographs, and the limits that a cloud has to meet."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from evaluation.standards import TO_95, TVU
from refract import PinholeCamera
from survey.plan.choices import Choices, Quality
from survey.plan.decisions import Decision

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


def image_decision(camera: PinholeCamera, scale: float, chosen: Choices) -> Decision:
    """Line of the plan on the working size."""
    size = f"images of {camera.width} x {camera.height} px"
    if chosen.image_scale is not None:
        by = "set by --image-scale" if chosen.aim is None else "chosen for the aim"
        return Decision("image scale", f"{scale:g}", f"{by}, for {size}")
    if scale == 1.0:
        return Decision("image scale", "1", f"{size} are worked on whole")
    limit = f"at most {RECIPES[chosen.quality].megapixels:g} Mpx for {chosen.quality} quality"
    return Decision("image scale", f"{scale:g}", f"{size} are halved until they have {limit}")


def image_scale(width: int, height: int, megapixels: float) -> float:
    """Scale [-], at most 1, that reduces an image of a size [px] to a limit [px]."""
    halvings = math.ceil(0.5 * math.log2(width * height / (1e6 * megapixels)) - 1e-9)
    return 0.5 ** max(halvings, 0)


def max_height_std(gsd_m: float) -> float:
    """Largest standard deviation [m] of a height, all included, at a ground sampling distance [m]."""
    return max(MAX_STD_GSD * gsd_m, STRICTEST_ORDER_M)
