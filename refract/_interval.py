"""Interval arithmetic on numpy arrays: the proof behind `refract.fermat`.

A result contains every value that the operation takes over its arguments: bounds move outward by one unit in the
last place after the correctly rounded operations, by a few after sine and cosine. An `Interval` answers numpy's
functions and operators (NEP 13), so formulas written once for numbers also give enclosures.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

# One unit in the last place is at most this part of a number, or this much (the smallest normal number).
_ULP, _LEAST = 2.0**-52, 2.0**-1022
# numpy's sine and cosine are good to 4 units in the last place, of values of at most one: 9e-16.
_SINE_SLACK = 1e-15


class Interval(NDArrayOperatorsMixin):
    """Arrays of closed intervals from ``lo`` to ``hi``, element by element."""

    def __init__(self, lo, hi):
        self.lo, self.hi = lo, hi

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        rule = _RULES.get(ufunc)
        if rule is None or method != "__call__" or kwargs:
            return NotImplemented
        return rule(*(x if isinstance(x, Interval) else Interval(x, x) for x in inputs))

    @property
    def magnitude(self) -> np.ndarray:
        """The largest absolute value."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))

    @property
    def misses_zero(self) -> np.ndarray:
        """True where zero lies outside."""
        return (self.lo > 0.0) | (self.hi < 0.0)


def _outward(lo, hi) -> Interval:
    return Interval(lo - (_ULP * np.abs(lo) + _LEAST), hi + (_ULP * np.abs(hi) + _LEAST))


def _hull(*corners) -> Interval:
    lo, hi = corners[0], corners[0]
    for corner in corners[1:]:
        lo, hi = np.minimum(lo, corner), np.maximum(hi, corner)
    return _outward(lo, hi)


def _multiply(a: Interval, b: Interval) -> Interval:
    if a is b:  # a square is never negative
        low = np.where(a.misses_zero, np.minimum(np.abs(a.lo), np.abs(a.hi)), 0.0)
        return _outward(low * low, a.magnitude * a.magnitude)
    return _hull(a.lo * b.lo, a.lo * b.hi, a.hi * b.lo, a.hi * b.hi)


def _divide(a: Interval, b: Interval) -> Interval:
    if not np.all(b.misses_zero):
        b = Interval(np.where(b.misses_zero, b.lo, np.nan), np.where(b.misses_zero, b.hi, np.nan))
    return _hull(a.lo / b.lo, a.lo / b.hi, a.hi / b.lo, a.hi / b.hi)


def _sqrt(a: Interval) -> Interval:
    return _outward(np.sqrt(np.maximum(a.lo, 0.0)), np.sqrt(a.hi))


def _cos(a: Interval) -> Interval:
    """Plus or minus one where a multiple of pi, even or odd, may lie inside; else the ends decide."""
    turn = 2.0 * np.pi
    slack = 1e-15 * (1.0 + np.maximum(np.abs(a.lo), np.abs(a.hi)))  # multiples of pi and the quotient are rounded
    crests = np.floor((a.hi + slack) / turn) >= np.ceil((a.lo - slack) / turn)
    troughs = np.floor((a.hi + slack) / turn - 0.5) >= np.ceil((a.lo - slack) / turn - 0.5)
    first, last = np.cos(a.lo), np.cos(a.hi)
    low = np.where(troughs, -1.0, np.minimum(first, last) - _SINE_SLACK)
    high = np.where(crests, 1.0, np.maximum(first, last) + _SINE_SLACK)
    return Interval(low, high)


_QUARTER_TURN = Interval(np.nextafter(np.pi / 2.0, 0.0), np.nextafter(np.pi / 2.0, 2.0))


_RULES: dict[np.ufunc, Callable[..., Interval]] = {
    np.add: lambda a, b: _outward(a.lo + b.lo, a.hi + b.hi),
    np.subtract: lambda a, b: _outward(a.lo - b.hi, a.hi - b.lo),
    np.multiply: _multiply,
    np.divide: _divide,
    np.negative: lambda a: Interval(-a.hi, -a.lo),
    np.sqrt: _sqrt,
    np.cos: _cos,
    np.sin: lambda a: _cos(a - _QUARTER_TURN),
}
