"""Quantities as text: significant digits, a unit that no line break takes from its number, sizes of memory.

Lengths are in metres unless a caller is within `lengths_in_feet`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeGuard

from survey.errors import SurveyError

if TYPE_CHECKING:
    from pyproj import CRS

# Between a number and its unit, and between groups of three digits.
NO_BREAK, NARROW = "\u00a0", "\u202f"
MINUS, UNKNOWN = "−", "unknown"
# Lengths below this are written in millimetres [m].
_SMALL_M = 0.5
# Length of the foot in use [m]; None for metres.
_FOOT_M: ContextVar[float | None] = ContextVar("foot_m", default=None)
_UNITS = {"": 1.0, "B": 1.0, "KB": 1e3, "MB": 1e6, "GB": 1e9, "TB": 1e12, "KIB": 2**10, "MIB": 2**20, "GIB": 2**30}
# International foot [m].
_FOOT = 0.3048
# Relative difference up to which a unit is a foot: international and US survey feet differ by two parts in a million.
_ALIKE = 1e-4


def typeset(text: str) -> str:
    """A text of logs with the signs that numbers of a page have: a minus that is no hyphen, and ±."""
    return re.sub(r"(?<![\w.])-(?=\.?\d)", MINUS, text.replace("+-", "±"))


@contextmanager
def lengths_in_feet(foot_m: float | None) -> Iterator[None]:
    """Within this block lengths are shown in feet of so many metres; None: in metres."""
    token = _FOOT_M.set(foot_m)
    try:
        yield
    finally:
        _FOOT_M.reset(token)


@dataclass(frozen=True)
class LengthUnit:
    """A unit for lengths shown together."""

    name: str
    per_metre: float
    decimals: int

    @staticmethod
    def of(values_m: Iterable[float | None]) -> LengthUnit:
        """The unit for values [m] of one column, by the largest: millimetres below half a metre, else metres; feet."""
        largest = max((abs(value) for value in values_m if is_known(value)), default=0.0)
        if (foot_m := _FOOT_M.get()) is not None:
            return LengthUnit("ft", 1.0 / foot_m, 3 if largest < 10.0 else 2)
        if largest >= _SMALL_M:
            return LengthUnit("m", 1.0, 3 if largest < 10.0 else 2)
        return LengthUnit("mm", 1000.0, 1 if largest < 0.1 else 0)

    @staticmethod
    def of_heights() -> LengthUnit:
        """The unit of heights and depths, to the centimetre or the hundredth of a foot."""
        foot_m = _FOOT_M.get()
        return LengthUnit("m", 1.0, 2) if foot_m is None else LengthUnit("ft", 1.0 / foot_m, 2)

    def number(self, value_m: float | None) -> str:
        """A length without its unit."""
        return number(None if value_m is None else value_m * self.per_metre, self.decimals)

    def text(self, value_m: float | None) -> str:
        """A length with its unit."""
        return self.number(value_m) + NO_BREAK + self.name if is_known(value_m) else UNKNOWN


def distance_text(metres: float) -> str:
    """A distance of places as people write it: whole metres below a kilometre, then kilometres.

    Examples
    --------
    >>> distance_text(0.4), distance_text(12.0), distance_text(4321.0), distance_text(56789.0), distance_text(5.2e6)
    ('0.4 m', '12 m', '4.3 km', '57 km', '5,200 km')
    """
    if not math.isfinite(metres):
        return "an unknown distance"
    if round(metres) < 1000:
        return f"{metres:.0f} m" if metres >= 9.5 else f"{metres:.1f} m"
    km = metres / 1000.0
    return f"{km:,.0f} km" if km >= 9.95 else f"{km:.1f}".removesuffix(".0") + " km"


def decimals_of(std: float | None) -> int:
    """Decimals that show two digits of a standard deviation; four where it is none."""
    return min(max(1 - math.floor(math.log10(std)), 0), 9) if is_known(std) and std > 0.0 else 4


def is_known(value: float | None) -> TypeGuard[float]:
    """Whether there is a finite value; None, NaN and infinity are shown as unknown."""
    return value is not None and math.isfinite(value)


def number(value: float | None, decimals: int) -> str:
    """A number with a fixed number of decimals, and never a minus before zero."""
    return f"{value:z.{decimals}f}".replace("-", MINUS) if is_known(value) else UNKNOWN


def round_up(value: float, steps: Sequence[float]) -> float:
    """The next larger round number to a positive one: a step, rising from 1 to 10, times a power of ten."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(float(f"{step * power:.6g}") for step in steps if step * power >= value * (1.0 - 1e-9))


def length(value_m: float | None) -> str:
    """A length [m] on its own: 12.3 mm or 0.612 m."""
    return LengthUnit.of([value_m]).text(value_m)


def share(value: float | None) -> str:
    """A share, 0 to 1, as per cent."""
    return f"{100.0 * value:.1f}{NO_BREAK}%" if is_known(value) else UNKNOWN


def count(value: float) -> str:
    """A whole number in groups of three, e.g. 1 234 567."""
    return f"{round(value):,}".replace(",", NARROW)


def height(value_m: float) -> str:
    """A height or depth as surveyors write it, to the centimetre or the hundredth of a foot."""
    return LengthUnit.of_heights().text(value_m)


def distance(value_m: float) -> str:
    """A distance over ground or through the air, to the decimetre or the tenth of a foot."""
    unit = LengthUnit.of_heights()
    return f"{number(value_m * unit.per_metre, 1)}{NO_BREAK}{unit.name}"


def area(value_m2: float) -> str:
    """An area, in whole square metres or feet."""
    unit = LengthUnit.of_heights()
    return f"{count(value_m2 * unit.per_metre**2)}{NO_BREAK}{unit.name}²"


def volume(value_m3: float) -> str:
    """A volume, in cubic metres or feet."""
    unit = LengthUnit.of_heights()
    value = value_m3 * unit.per_metre**3
    return f"{count(value) if abs(value) >= 100.0 else number(value, 1)}{NO_BREAK}{unit.name}³"


def density(value_per_m2: float) -> str:
    """Points per square metre or square foot."""
    unit = LengthUnit.of_heights()
    value = value_per_m2 / unit.per_metre**2
    return f"{count(value) if value >= 10.0 else number(value, 1)} per {unit.name}²"


def bytes_of(text: str) -> float:
    """Bytes of a size as text: "8GB", "500 MB", "2GiB"."""
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]*)?)\s*([A-Za-z]*)\s*", text)
    if found is None or found[2].upper() not in _UNITS or float(found[1]) <= 0.0:
        raise SurveyError(f"--memory is {text!r}, expected a size such as 8GB or 500MB")
    return float(found[1]) * _UNITS[found[2].upper()]


def room(num_bytes: float) -> str:
    """Memory or disk space [bytes] that is free, as text, rounded down."""
    if num_bytes >= 1e9:
        return f"{math.floor(num_bytes / 1e8) / 10:.1f} GB"
    return f"{math.floor(num_bytes / 1e7) * 10} MB"


def size(num_bytes: float) -> str:
    """Memory or disk space [bytes] that is needed, as text."""
    return f"{num_bytes / 1e9:.1f} GB" if num_bytes >= 1e9 else f"{math.ceil(num_bytes / 1e7) * 10} MB"


def foot_m(units: str | None, crs: CRS) -> float | None:
    """The length of the foot that lengths are shown in [m], None for metres.

    ``units`` None leaves it to the CRS, which has a height; "feet" are those of the CRS, else international ones.
    """
    if units == "metres":
        return None
    # Here, so that programs that show no lengths of a CRS start without PROJ.
    from geo.crs import height_unit_m, horizontal_unit

    of_crs = [unit for unit in (height_unit_m(crs), horizontal_unit(crs)) if abs(unit / _FOOT - 1.0) < _ALIKE]
    if of_crs:
        return of_crs[0]
    return _FOOT if units == "feet" else None


def named(names: Sequence[str], noun: str, what: str) -> list[str]:
    """A warning that counts and names items, as "2 images without a pose, left out: a.jpg, b.jpg"; none of none."""
    return [f"{len(names)} {noun}{'s' if len(names) > 1 else ''} {what}: {listed(names)}"] if names else []


def listed(names: Sequence[str], most: int = 10) -> str:
    """The first of some names, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more
