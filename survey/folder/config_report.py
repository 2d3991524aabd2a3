"""[report] of survey.toml: what the head of the report says of the work, besides what the photographs tell."""

from __future__ import annotations

from dataclasses import dataclass

from survey.errors import ConfigError

METRES, FEET = "metres", "feet"


@dataclass(frozen=True)
class ReportConfig:
    """[report]: words for the head of report.html and report.json."""

    project: str | None = None
    operator: str | None = None  # who surveyed: a person, a company
    units: str | None = None  # of lengths in the report, "metres" or "feet"; default: feet where crs has them

    def __post_init__(self):
        if self.units not in (None, METRES, FEET):
            raise ConfigError(f'[report] units = "{self.units}", expected "{METRES}" or "{FEET}"')
