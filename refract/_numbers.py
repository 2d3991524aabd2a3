"""Checks of arguments: numbers of a water surface, and their ranges.

Numbers are plain ones, or arrays of numpy or torch, which may carry gradients. Impossible values are errors; values
outside the range to which a formula was fitted are warnings.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping

import numpy as np

from refract._array import as_like, as_numpy, namespace, transformed


def number(value):
    """A plain number as float, several as numpy float64; arrays of torch as they are."""
    if namespace(value).name != "numpy":
        return value
    array = np.asarray(value, dtype=np.float64)
    return array if array.ndim else float(array)


def hold(condition: Callable[[np.ndarray], np.ndarray], *numbers) -> bool:
    """Whether a condition holds for all values; True while a transform of torch hides the values of tensors."""
    if transformed():
        return True
    return all(bool(condition(as_numpy(value)).all()) for value in numbers)


def require_index(index) -> None:
    """ValueError unless all values of an index of water relative to air are 1 to 2."""
    if not hold(lambda n: (n >= 1.0) & (n <= 2.0), index):
        raise ValueError(f"expected an index of water relative to air of 1 to 2 (fresh: 1.333), got {index}")


def in_library(value, like):
    """Several numbers of numpy in the library of the array `like`, in float64; all else as it is."""
    xp = namespace(like)
    if not isinstance(value, np.ndarray) or xp.name == "numpy":
        return value
    return as_like(value, xp.double(like))


class OutsideFit(UserWarning):
    """A formula is used outside the range of values that it was fitted to."""


def require(name: str, values, holds, expected: str) -> None:
    """Raise where `values`, but for NaN, are not what ``holds(values)`` says.

    Raises ValueError: with the first of the wrong values, and what was `expected`.
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
