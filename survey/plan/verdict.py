"""Verdicts of `check`: a word, the finding, and the remedy in one sentence."""

from __future__ import annotations

from enum import StrEnum


class Verdict(StrEnum):
    """Suitability for measuring the bed."""

    good = "good"
    fair = "fair"
    poor = "poor"


def by_limits(value: float, good: float, fair: float) -> Verdict:
    """The verdict on a value by the limits up to which it is good or fair; where good > fair, from which on."""
    sign = 1.0 if good <= fair else -1.0
    if sign * value <= sign * good:
        return Verdict.good
    return Verdict.fair if sign * value <= sign * fair else Verdict.poor


def judged(verdict: Verdict, found: str, advice: str) -> str:
    """The sentence that `check` prints; advice only where there is something to mend."""
    return f"{verdict}: {found}" + ("" if verdict is Verdict.good else f"; {advice}")
