"""[report] of survey.toml: what the head of the report says of the work, besides what the photographs tell."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ReportConfig:
    """[report]: words for the head of report.html and report.json."""

    project: str | None = None
    operator: str | None = None  # who surveyed: a person, a company
