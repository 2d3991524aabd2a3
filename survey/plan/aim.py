"""Aims of a run in place of a quality: a standard deviation, a time, or both; and their recipes.

The recipes go from images as small as can be matched to whole ones, at each size without and with the
solver; so many views get a height map that three see every place. More views, as standard and fine have them, add
about a hundredth of the points and do not change the standard deviation (docs/targets.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any

from survey.display.quantities import length
from survey.errors import SurveyError
from survey.plan.choices import USUAL, Choices
from survey.plan.recipe import Recipe
from survey.settings.tables import ProcessConfig

# The standard deviation is asked for this share of the ground that has points.
SHARE = 0.95
# Smaller images are not matched [px along the longer side]; a quarter of the smallest that any survey here has.
_LEAST_SIDE_PX = 200
# Three confirm each other, and one looks under from each quarter.
_TIMES_SEEN = (3, 1)


@dataclass(frozen=True)
class Aim:
    """Target of a run: a standard deviation, a time, or both."""

    # Standard deviation of heights [m], each point's own without `std_common`, of `SHARE` of the ground
    std_m: float | None = None
    seconds: float | None = None  # Wall clock of the whole run [s]

    def __str__(self) -> str:
        parts = []
        if self.std_m is not None:
            parts.append(f"a standard deviation of {length(self.std_m)} on {100 * SHARE:g} % of the ground")
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
        If one is no positive number, or the quality, the field or the image scale is set too.
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
    said = {field.name: getattr(asked, field.name) for field in fields(Choices)}
    # Keys and reports have words, not the members of an enumeration.
    words: dict[str, Any] = {
        name: str(value) if isinstance(value, str) else value for name, value in said.items() if value is not None
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
