"""Recipes of qualities and aims, the working size of photographs, and the limits that a cloud has to meet.

An aim is a standard deviation, a time, or both, in place of a quality. Its recipes go from images as small as can be
matched to whole ones, at each size without and with the solver; so many views get a height map that three see every
place. More views, as standard and fine have them, add about a hundredth of the points and do not change the standard
deviation (docs/targets.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

from evaluation.standards import TO_95, TVU
from refract import PinholeCamera
from survey.display.quantities import length
from survey.errors import SurveyError
from survey.plan.choices import USUAL, Choices, Quality
from survey.plan.decisions import Decision
from survey.settings.tables import ProcessConfig

# In place of a quality where `recipes_for` makes the recipe.
AIMED = "aimed"
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
    rays_per_cell: float = 15.0  # Rays that the slab learns from, per cell of one ground sampling distance


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


def image_decision(camera: PinholeCamera, scale: float, quality: str, recipe: Recipe, *, asked: bool) -> Decision:
    """Line of the plan on the working size."""
    size = f"images of {camera.width} x {camera.height} px"
    if asked:
        return Decision("image scale", f"{scale:g}", f"set by --image-scale, for {size}")
    if quality == AIMED:
        reason = f"of {size}; each round has its own, and poses are looked at with that of standard"
        return Decision("image scale", f"{scale:g}", reason)
    if scale == 1.0:
        return Decision("image scale", "1", f"{size} are worked on whole")
    limit = f"at most {recipe.megapixels:g} Mpx for {quality} quality"
    return Decision("image scale", f"{scale:g}", f"{size} are halved until they have {limit}")


def image_scale(width: int, height: int, megapixels: float) -> float:
    """Scale [-], at most 1, that reduces an image of a size [px] to a limit [px]."""
    halvings = math.ceil(0.5 * math.log2(width * height / (1e6 * megapixels)) - 1e-9)
    return 0.5 ** max(halvings, 0)


def max_height_std(gsd_m: float) -> float:
    """Largest standard deviation [m] of a height, all included, at a ground sampling distance [m]."""
    return max(MAX_STD_GSD * gsd_m, STRICTEST_ORDER_M)


# The target standard deviation holds for this share of the ground that has points: it is that quantile of the heights'.
STD_QUANTILE = 0.95
# Smaller images are not matched [px along the longer side]; a quarter of the smallest that any survey here has.
_LEAST_SIDE_PX = 200
# Three confirm each other, and one looks under from each quarter.
_TIMES_SEEN = (3, 1)


@dataclass(frozen=True)
class Aim:
    """Target of a run: a standard deviation, a time, or both."""

    # Standard deviation of heights [m], each point's own without `std_common`, of `STD_QUANTILE` of the ground
    std_m: float | None = None
    seconds: float | None = None  # Wall clock of the whole run [s]

    def __str__(self) -> str:
        parts = []
        if self.std_m is not None:
            parts.append(f"a standard deviation of {length(self.std_m)} on {100 * STD_QUANTILE:g} % of the ground")
        if self.seconds is not None:
            parts.append(f"at most {self.seconds:g} s")
        return " in ".join(parts)


def aim_of(
    std_m: float | None, seconds: float | None, *, quality: str | None, field: str, scale: float | None = None
) -> Aim | None:
    """Aim given by the options of a run; None where neither is given.

    Raises
    ------
    SurveyError
        If one is not a positive number, or the quality, the field or the image scale is set too.
    """
    if std_m is None and seconds is None:
        return None
    for name, value, unit in (("--target-std", std_m, "m"), ("--time-budget", seconds, "s")):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise SurveyError(f"{name} is {value:g}, expected a number above zero, in {unit}")
    if quality is not None:
        raise SurveyError(
            f"--quality {quality} is a fixed recipe, and --target-std and --time-budget choose their own; leave one out"
        )
    if field != "auto":
        raise SurveyError(
            f"--field {field} and an aim (--target-std, --time-budget), which decides on the solver; leave one out"
        )
    if scale is not None:
        raise SurveyError(
            f"--image-scale {scale:g} and an aim (--target-std, --time-budget), which chooses it; leave one out"
        )
    return Aim(std_m, seconds)


def aim_and_choices(asked: ProcessConfig) -> tuple[Aim | None, Choices]:
    """Aim and choices of a run, defaults filled in.

    Raises
    ------
    SurveyError
        See `aim_of` and `Choices`.
    """
    aim = aim_of(
        asked.target_std_m,
        asked.time_budget_s,
        quality=asked.quality,
        field=asked.field or USUAL.field,
        scale=asked.image_scale,
    )
    chosen = {field.name: getattr(asked, field.name) for field in fields(Choices)}
    # Keys and reports have words, not the members of an enumeration.
    words: dict[str, Any] = {
        name: str(value) if isinstance(value, str) else value for name, value in chosen.items() if value is not None
    }
    return aim, replace(USUAL, **words)


def recipes_for(sizes_px: list[tuple[int, int]]) -> tuple[Recipe, ...]:
    """Recipes for images of these sizes (width, height), in ascending order of work."""
    width, height = max(sizes_px, key=lambda size: size[0] * size[1])
    halvings = max(math.floor(math.log2(min(max(size) for size in sizes_px) / _LEAST_SIDE_PX)), 0)
    return tuple(
        Recipe(megapixels=width * height * 0.25**number / 1e6, times_seen=_TIMES_SEEN, field=field)
        for number in range(halvings, -1, -1)
        for field in ("off", "solver")
    )
