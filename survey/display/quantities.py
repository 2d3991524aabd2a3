"""Quantities as text for people: sensible digits, and a unit that no line break takes from its number."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TypeGuard

# Between a number and its unit, and between groups of three digits.
NO_BREAK, NARROW = "\u00a0", "\u202f"
MINUS, UNKNOWN = "−", "unknown"
# Lengths below this are written in millimetres [m].
_SMALL_M = 0.5


@dataclass(frozen=True)
class LengthUnit:
    """A unit for lengths shown together.

    Attributes
    ----------
    name : str
    per_metre : float
    decimals : int
    """

    name: str
    per_metre: float
    decimals: int

    @staticmethod
    def of(values_m: Iterable[float | None]) -> LengthUnit:
        """The unit for values [m] of one column, by the largest: millimetres below half a metre, else metres."""
        largest = max((abs(value) for value in values_m if is_known(value)), default=0.0)
        if largest >= _SMALL_M:
            return LengthUnit("m", 1.0, 3 if largest < 10.0 else 2)
        return LengthUnit("mm", 1000.0, 1 if largest < 0.1 else 0)

    def number(self, value_m: float | None) -> str:
        """A length without its unit."""
        return number(None if value_m is None else value_m * self.per_metre, self.decimals)

    def text(self, value_m: float | None) -> str:
        """A length with its unit."""
        return self.number(value_m) + NO_BREAK + self.name if is_known(value_m) else UNKNOWN


def is_known(value: float | None) -> TypeGuard[float]:
    """Whether there is a finite value; None, NaN and infinity are shown as unknown."""
    return value is not None and math.isfinite(value)


def number(value: float | None, decimals: int) -> str:
    """A number with a fixed number of decimals, and never a minus before zero."""
    return f"{value:z.{decimals}f}".replace("-", MINUS) if is_known(value) else UNKNOWN


def length(value_m: float | None) -> str:
    """A length [m] on its own: 12.3 mm or 0.612 m."""
    return LengthUnit.of([value_m]).text(value_m)


def share(value: float | None) -> str:
    """A share of one as per cent."""
    return f"{100.0 * value:.1f}{NO_BREAK}%" if is_known(value) else UNKNOWN


def count(value: float) -> str:
    """A whole number in groups of three, e.g. 1 234 567."""
    return f"{round(value):,}".replace(",", NARROW)


def metres(value: float) -> str:
    """A height or depth as surveyors write it, to the centimetre."""
    return f"{number(value, 2)}{NO_BREAK}m"


def with_unit(text: str, unit: str) -> str:
    """A number and its unit, if it has one; degrees have no space before them."""
    return text + (unit if unit == "°" else f"{NO_BREAK}{unit}" if unit else "")
