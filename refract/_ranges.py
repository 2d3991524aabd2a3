"""Ranges of arguments: an error for what cannot be, a warning where a formula was not fitted."""

from __future__ import annotations

import warnings
from collections.abc import Mapping

import numpy as np

from refract._array import as_numpy


class OutsideFit(UserWarning):
    """A formula is used outside the range of values that it was fitted to."""


def require(name: str, values, holds, expected: str) -> None:
    """Raise where `values`, but for NaN, are not what ``holds(values)`` says.

    Raises
    ------
    ValueError
        With the first of the wrong values, and what was `expected`.
    """
    values = as_numpy(values)
    wrong = values[~(holds(values) | np.isnan(values))]
    if wrong.size:
        raise ValueError(f"{name} is {wrong[0]:g}, expected {expected}; check its unit and its sign")


def warn_outside(model: str, ranges: Mapping[str, tuple[float, float]], *, stacklevel: int, **given) -> None:
    """Warn `OutsideFit`, naming the range of `model`, for each of the `given` values that lies outside it."""
    for name, (low, high) in ranges.items():
        values = as_numpy(given[name])
        outside = values[(values < low) | (values > high)]
        if outside.size:
            message = f"{name} is {outside[0]:g}, outside the range {low:g} to {high:g} of {model}"
            warnings.warn(message, OutsideFit, stacklevel=stacklevel)
