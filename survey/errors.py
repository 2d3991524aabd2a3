"""Errors of a survey; each message says what was found, what was expected and how to fix it."""

from __future__ import annotations

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
