"""Findings of readers: assumptions and warnings, for the log, the plan and the report."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Findings:
    """Sentences that a reader returns with its result.

    Attributes
    ----------
    assumptions : tuple of str
        What nobody said and was assumed.
    warnings : tuple of str
        What is left out, or more likely a mistake.
    """

    assumptions: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def __add__(self, other: Findings) -> Findings:
        return Findings(self.assumptions + other.assumptions, self.warnings + other.warnings)
