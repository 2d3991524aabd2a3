"""Options of a run, in a module that is quick to import, since the command line needs it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

from survey.display.quantities import bytes_of, length
from survey.errors import SurveyError
from survey.words import FIELDS, SCALES, Device, Poses, Quality, expected_of

if TYPE_CHECKING:
    from survey.settings.tables import ProcessConfig

# The target standard deviation holds for this share of the ground that has points: it is that quantile of the heights'.
STD_QUANTILE = 0.95


# Ten thousand square kilometres in tiles of the largest size; workers of the largest clusters of Dask.
_MOST_TILES, _MOST_WORKERS = 10_000, 1_000


@dataclass(frozen=True)
class Aim:
    """Target of a run, from which quality and image scale follow: a standard deviation, a time, or both."""

    # Standard deviation of heights [m], each point's own without `std_common`, of `STD_QUANTILE` of the ground
    std_m: float | None = None
    seconds: float | None = None  # Wall clock of the whole run [s]

    def __post_init__(self) -> None:
        for name, value, unit in (("--target-std", self.std_m, "m"), ("--time-budget", self.seconds, "s")):
            if value is not None and not (math.isfinite(value) and value > 0.0):
                raise SurveyError(f"{name} is {value:g}, expected a number above zero, in {unit}")

    def __str__(self) -> str:
        parts = []
        if self.std_m is not None:
            parts.append(f"a standard deviation of {length(self.std_m)} on {100 * STD_QUANTILE:g} % of the ground")
        if self.seconds is not None:
            parts.append(f"at most {self.seconds:g} s")
        return " in ".join(parts)


@dataclass(frozen=True)
class Choices:
    """Options of a run; the words are those of `survey.words`.

    Attributes
    ----------
    quality, device, field, poses : str
    image_scale : [-], optional
        Scale of the photographs in the run, one of `SCALES`; default by their size and the quality.
    aim : Aim, optional
        From which `survey.run.aim` chooses quality and image scale.
    calibrate_water : bool
        Whether the water is found as if nothing were known of it.
    true_colour : bool
        Whether points get the colour of the bed without its water.
    tiles : int, optional
        Number of tiles of the ground, worked on one after the other; default by the memory.
    memory : str, optional
        Memory that the run may take, as "8GB"; default: most of what is free.
    workers : int, optional
        Number of processes that compute tiles; by default one, and on the command line by tiles, cores and memory.
        With a scheduler the number of its workers that the run waits for.
    scheduler : str, optional
        Address of a Dask scheduler whose workers compute tiles, features and matches, as "tcp://host:8786".
    """

    quality: str = Quality.standard.value
    device: str = Device.auto.value
    field: str = "auto"
    poses: str = Poses.auto.value
    image_scale: float | None = None
    aim: Aim | None = None
    calibrate_water: bool = False
    true_colour: bool = False
    tiles: int | None = None
    memory: str | None = None
    workers: int | None = None
    scheduler: str | None = None

    def __post_init__(self) -> None:
        for name, words in (
            ("quality", Quality),
            ("device", Device),
            ("field", FIELDS),
            ("poses", Poses),
        ):
            if getattr(self, name) not in list(words):
                raise SurveyError(f"{name} is {getattr(self, name)}, {expected_of(words, getattr(self, name))}")
        if self.image_scale is not None and self.image_scale not in SCALES:
            known = ", ".join(f"{each:g}" for each in SCALES)
            raise SurveyError(f"image scale is {self.image_scale:g}, expected one of {known}")
        for option, number, most in (("tiles", self.tiles, _MOST_TILES), ("workers", self.workers, _MOST_WORKERS)):
            if number is not None and not 1 <= number <= most:
                raise SurveyError(f"--{option} is {number}, expected a number from 1 to {most}")
        if self.memory is not None:
            bytes_of(self.memory)


# The defaults.
USUAL = Choices()


def choices_of(asked: ProcessConfig) -> Choices:
    """Options of a run, defaults filled in."""
    given = {name: value for name, value in vars(asked).items() if value is not None}
    std_m, seconds = given.pop("target_std_m", None), given.pop("time_budget_s", None)
    # Keys and reports have words, not the members of an enumeration.
    words: dict[str, Any] = {name: str(value) if isinstance(value, str) else value for name, value in given.items()}
    if std_m is None and seconds is None:
        return replace(USUAL, **words)
    for name in ("quality", "field", "image_scale"):
        if words.get(name, "auto") != "auto":
            option = f"--{name.replace('_', '-')} {words[name]}"
            raise SurveyError(f"{option} and an aim (--target-std, --time-budget), which chooses it; leave one out")
    return replace(USUAL, **words, aim=Aim(std_m, seconds))
