"""Options of a run, in a module that is quick to import, since the command line needs it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from survey.display.quantities import bytes_of, length
from survey.files.toml_table import OPTION, require_valid
from survey.settings.tables import ProcessConfig
from survey.words import Device, Poses, Quality

# The target standard deviation holds for this share of the ground that has points: it is that quantile of the heights'.
STD_QUANTILE = 0.95


@dataclass(frozen=True)
class Choices(ProcessConfig):
    """Options of a run, with their defaults; the words are those of `survey.words`.

    Attributes
    ----------
    quality : "draft", "standard" or "fine"
    device : "auto", "cpu" or "cuda"
    field : "auto", "solver", "boxes", "off" or a model of `fields.models.IN_LAYER`
        What refines the heights of the sweep: least squares over all photographs, with boxes or alone, nothing, or a
        field trained in a layer about them, for ``render --field``; "auto" leaves it to the plan.
    target_std_m : [m], optional
        Standard deviation that is wanted on 95 % of the ground, each height's own without `std_common`: the least work
        that is foreseen to reach it; `survey.run.aim` chooses quality and image scale.
    time_budget_s : [s], optional
        Wall clock of the whole run: the best that is foreseen to fit.
    poses : "auto", "fixed" or "refine"
        Whether poses and lens are adjusted together with the water; "auto" leaves it to the plan.
    image_scale : float, optional
        At which photographs are worked on: 1, a half, a quarter, ...; default by their size and the quality.
    calibrate_water : bool
        First estimate level, slopes and index of the water from the photographs, as if nothing were known of them;
        those that are not observable keep their given values.
    true_colour : bool
        Give the points the bed's own colour, the water taken away, instead of the photographs'.
    tiles : int, optional
        Rectangles of the ground that are worked on one after the other; default: as the memory asks for.
    memory : str, optional
        Memory that the run may take, as "8GB"; default: most of what is free.
    workers : int, optional
        Processes that compute tiles; default one, and on the command line by tiles, cores and memory. Of a scheduler
        those that are waited for. A script that gives more than one needs ``if __name__ == "__main__":``, as each
        process loads it again.
    scheduler : str, optional
        Address of a Dask scheduler whose workers compute tiles, features and matches, as "tcp://host:8786".
    """

    quality: str = Quality.standard.value
    device: str = Device.auto.value
    field: str = "auto"
    poses: str = Poses.auto.value
    calibrate_water: bool = False
    true_colour: bool = False

    def __post_init__(self) -> None:
        require_valid(self, ProcessConfig, lambda field: option_of(field.name))
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


def option_of(key: str) -> str:
    """The option of the command line that sets a key of [process]."""
    names = {field.name: field.metadata[OPTION].name for field in fields(ProcessConfig)}
    return names[key] or f"--{key.replace('_', '-')}"


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
