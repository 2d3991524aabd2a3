"""Options of a run, in a module that is quick to import, since the command line needs it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from survey.display.quantities import bytes_of, length
from survey.files.toml_table import OPTION, option_name, require_valid
from survey.settings.tables import ProcessConfig
from survey.words import Device, Poses, Quality

# The target standard deviation holds for this share of the ground that has points: it is that quantile of the heights'.
STD_QUANTILE = 0.95


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
