"""Errors and findings of a survey; each message says what was found, what was expected and how to fix it."""

from __future__ import annotations

import math
from dataclasses import dataclass

# The settings of a survey, as messages name them.
FILE_NAME = "survey.toml"


class SurveyError(ValueError):
    """The survey or the options cannot be used as they are; the command line exits with code 2."""


class ConfigError(SurveyError):
    """A key of survey.toml is missing, unknown, of the wrong kind or contradicts another one."""


class PosesError(SurveyError):
    """A file of camera poses cannot be read, or its poses cannot be true."""


class ImageError(SurveyError):
    """An image is missing, damaged or not of the size that its camera has."""


class OutputError(SurveyError):
    """A result must not, or cannot, be written to the requested place."""


class ControlError(SurveyError):
    """A file of control points, marks or check points cannot be read, or cannot be true."""


class NotReached(SurveyError):
    """A URL did not answer."""


@dataclass(frozen=True)
class Findings:
    """Sentences that a reader returns with its result."""

    assumptions: tuple[str, ...] = ()  # What nobody said and was assumed
    warnings: tuple[str, ...] = ()  # What is left out, or more likely a mistake

    def __add__(self, other: Findings) -> Findings:
        return Findings(self.assumptions + other.assumptions, self.warnings + other.warnings)


@dataclass(frozen=True)
class GivenValueTest:
    """Test of a given parameter of water or lens against its estimate from the photographs."""

    name: str  # "level_m", "refractive_index", or of a lens as "camera0.f"
    # given, given_std: As survey.toml and the poses file say, or the defaults
    given: float
    given_std: float
    # difference, std: Of what photographs say less given; of what they say
    difference: float
    std: float

    @property
    def found(self) -> float:
        return self.given + self.difference

    @property
    def sigmas(self) -> float:
        return abs(self.difference) / math.hypot(self.std, self.given_std)

    @property
    def is_of_lens(self) -> bool:
        """Whether it tests a parameter of a lens, not of the water."""
        return self.name.startswith("camera")

    def __str__(self) -> str:
        """Both numbers in words."""
        unit, digits = {"level_m": (" m", 3), "f": (" px", 2)}.get(self.name.split(".")[-1], ("", 4))
        return (
            f"{self.name} is given as {self.given:.{digits}f} +- {self.given_std:.2g}{unit}, and a sample of "
            f"photographs says {self.found:.{digits}f} +- {self.std:.2g}{unit}"
        )
