"""What can be wrong with a survey; each message says what was found, what was expected and the mend."""

from __future__ import annotations

# The settings of a survey, as messages name them.
FILE_NAME = "survey.toml"


class SurveyError(ValueError):
    """The survey, or what was asked of it, cannot be used as it is; the command line ends with code 2."""


class ConfigError(SurveyError):
    """A key of survey.toml is missing, unknown, of the wrong kind or at odds with another one."""


class PosesError(SurveyError):
    """A file of camera poses cannot be read, or its poses cannot be true."""


class ImageError(SurveyError):
    """An image is missing, damaged or not of the size that its camera has."""


class OutputError(SurveyError):
    """A result must not, or cannot, be written where it was asked for."""
