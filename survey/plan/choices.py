"""Options of a run, the recipes of its qualities, the size of its photographs, and limits that a cloud has to meet."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from evaluation.standards import TO_95, TVU
from survey.display.quantities import bytes_of, length
from survey.files.toml_table import OPTION, option_name, require_valid
from survey.folder.survey import Survey
from survey.plan.area import flattened
from survey.plan.heights import camera_height_m
from survey.settings.tables import ProcessConfig
from survey.words import Device, Poses, Quality

# The target standard deviation holds for this share of the ground that has points: it is that quantile of the heights'.
STD_QUANTILE = 0.95
# Of the standard deviation that points have of their own, in ground sampling distances.
MAX_STD_GSD = 1.5
# Of the standard deviation of a height with all that it shares: that of IHO S-44's strictest order in shallow water,
# 77 mm, where one and a half ground sampling distances are less.
STRICTEST_ORDER_M = TVU[0][1] / TO_95
# Least share of the photographs that is not white: with less, no number of them shows the bed.
_LEAST_CLEAR_SHARE = 0.1


@dataclass(frozen=True)
class Choices(ProcessConfig):
    """Options of a run, with their defaults; the words are those of `survey.words`.

    A script that gives more than one worker needs ``if __name__ == "__main__":``, as each process loads it again.
    """

    quality: str = Quality.standard.value
    device: str = Device.auto.value
    field: str = "auto"
    poses: str = Poses.auto.value
    calibrate_water: bool = False
    true_colour: bool = False

    def __post_init__(self) -> None:
        require_valid(self, ProcessConfig, option_name)
        if self.memory is not None:
            bytes_of(self.memory)

    @property
    def aim(self) -> str:
        """What is asked for in place of a quality, in words."""
        parts = []
        if self.target_std_m is not None:
            parts.append(
                f"a standard deviation of {length(self.target_std_m)} on {100 * STD_QUANTILE:g} % of the ground"
            )
        if self.time_budget_s is not None:
            parts.append(f"at most {self.time_budget_s:g} s")
        return " in ".join(parts)


# Each with its help on the command line.
Choices.__doc__ = f"{Choices.__doc__}\n    Attributes\n    ----------\n" + "".join(
    f"    {field.name} : {field.type}\n        {field.metadata[OPTION].help}\n" for field in fields(ProcessConfig)
)


def option_of(key: str) -> str:
    """The option of the command line that sets a key of [process]."""
    return next(option_name(field) for field in fields(ProcessConfig) if field.name == key)


def choices_of(asked: ProcessConfig) -> Choices:
    """Options of a run, defaults filled in."""
    asked.require_one_kind(option_of)
    # Keys and reports have words, not the members of an enumeration.
    given: dict[str, Any] = {
        name: str(value) if isinstance(value, str) else value
        for name, value in vars(asked).items()
        if value is not None
    }
    return Choices(**given)


# The defaults.
USUAL = Choices()


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
