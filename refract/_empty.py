"""Empty arrays of Dr.Jit, which it combines with no numbers: functions are called with one NaN (or zero) instead.

numpy and torch need none of this: their empty arrays broadcast against numbers.
"""

from __future__ import annotations

import copy
import math
import sys
from dataclasses import fields, is_dataclass
from functools import wraps

from refract._array import compiling


def of_any_size(function):
    """Decorator: where an array of Dr.Jit among the arguments, or in one of them, is empty, all of the result are."""

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


def _has_empty(drjit, value) -> bool:
    if isinstance(value, tuple | list):
        return any(_has_empty(drjit, each) for each in value)
    if is_dataclass(value) and not isinstance(value, type):
        return any(_has_empty(drjit, getattr(value, each.name)) for each in fields(value))
    return drjit.is_array_v(value) and drjit.width(value) == 0


def _mapped(drjit, value, change):
    """The same value with its Dr.Jit arrays changed; a dataclass without asking it whether that is right."""
    if isinstance(value, tuple | list):
        changed = [_mapped(drjit, each, change) for each in value]
        return type(value)(*changed) if hasattr(value, "_fields") else type(value)(changed)
    if is_dataclass(value) and not isinstance(value, type):
        other = copy.copy(value)
        for each in fields(value):
            object.__setattr__(other, each.name, _mapped(drjit, getattr(value, each.name), change))
        return other
    return change(value) if drjit.is_array_v(value) else value
