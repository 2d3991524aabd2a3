"""Checks of arguments: numbers of a water surface, their ranges, and empty arrays.

Numbers are plain ones, or arrays of any library, which may carry gradients. Impossible values are errors; values
outside the range to which a formula was fitted are warnings. Dr.Jit cannot combine empty arrays with numbers: functions
are called with one NaN (or zero) instead.
"""

from __future__ import annotations

import copy
import math
import sys
import warnings
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, wraps

import numpy as np

from refract._array import as_like, as_numpy, compiling, namespace, transformed


def number(value):
    """A plain number as float, several as numpy float64; arrays of torch and Dr.Jit as they are."""
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
    return type(xp.double(like))(value.ravel()) if xp.name == "drjit" else as_like(value, xp.double(like))


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


def of_any_size(function):
    """Decorator: if a Dr.Jit array in the arguments, or in a dataclass among them, is empty, so are all results."""

    @wraps(function)
    def call(*args, **options):
        drjit = None if compiling() else sys.modules.get("drjit")
        if drjit is None or not any(_has_empty(drjit, each) for each in (*args, *options.values())):
            return function(*args, **options)

        def filled(array):
            if drjit.width(array):
                return array
            return type(array)(math.nan) if drjit.is_float_v(array) else drjit.zeros(type(array), 1)

        found = function(
            *(_mapped(drjit, each, filled) for each in args),
            **{name: _mapped(drjit, each, filled) for name, each in options.items()},
        )
        return _mapped(drjit, found, lambda array: drjit.zeros(type(array), 0))

    return call


# Most arguments: asking Dr.Jit about each would take as long as some calls.
_NOT_OF_DRJIT = (np.ndarray, float, int, type(None))


@cache
def _names_of_fields(kind: type) -> tuple[str, ...]:
    return tuple(each.name for each in fields(kind))


def _has_empty(drjit, value) -> bool:
    if isinstance(value, _NOT_OF_DRJIT):
        return False
    if isinstance(value, tuple | list):
        return any(_has_empty(drjit, each) for each in value)
    if is_dataclass(value) and not isinstance(value, type):
        return any(_has_empty(drjit, getattr(value, name)) for name in _names_of_fields(type(value)))
    return drjit.is_array_v(value) and drjit.width(value) == 0


def _mapped(drjit, value, change):
    """The same value with its Dr.Jit arrays changed; dataclasses are copied without their own checks."""
    if isinstance(value, tuple | list):
        changed = [_mapped(drjit, each, change) for each in value]
        return type(value)(*changed) if hasattr(value, "_fields") else type(value)(changed)
    if is_dataclass(value) and not isinstance(value, type):
        other = copy.copy(value)
        for each in fields(value):
            object.__setattr__(other, each.name, _mapped(drjit, getattr(value, each.name), change))
        return other
    return change(value) if drjit.is_array_v(value) else value
