"""Findings of readers: assumptions and warnings, for the log, the plan and the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Findings:
    """Sentences that a reader returns with its result."""

    assumptions: tuple[str, ...] = ()  # What nobody said and was assumed
    warnings: tuple[str, ...] = ()  # What is left out, or more likely a mistake

    def __add__(self, other: Findings) -> Findings:
        return Findings(self.assumptions + other.assumptions, self.warnings + other.warnings)
