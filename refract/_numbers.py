"""The numbers of a water surface: plain ones, or arrays of any library, which may carry gradients."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from refract._array import as_like, as_numpy, namespace, transformed


def number(value):
    """A plain number as float, several as numpy float64; arrays of torch and Dr.Jit as they are."""
    if namespace(value).name != "numpy":
        return value
    array = np.asarray(value, dtype=np.float64)
    return array if array.ndim else float(array)


def plain(value) -> float:
    """The value of a single number of any library, without its gradient.

    Raises
    ------
    ValueError
        If there are several.
    """
    array = as_numpy(value)
    if array.size != 1:
        raise ValueError(f"expected one number, got an array of shape {array.shape}; take one surface for each")
    return array.item()


def values(*numbers) -> np.ndarray:
    """All values in one row, without gradients; none while a transform of torch hides what tensors hold."""
    if transformed() or not numbers:
        return np.zeros(0)
    return np.concatenate([as_numpy(value).ravel() for value in numbers])


def require_index(index) -> None:
    """ValueError unless all values of an index of water relative to air are 1 to 2."""
    found = values(index)
    wrong = found[~((found >= 1.0) & (found <= 2.0))]
    if wrong.size:
        raise ValueError(f"expected an index of water relative to air of 1 to 2 (fresh: 1.333), got {wrong[0]}")


def in_library(value, like):
    """Several numbers of numpy in the library of the array `like`, in float64; all else as it is."""
    if not isinstance(value, np.ndarray) or namespace(like).name == "numpy":
        return value
    return as_like(value, namespace(like).double(like))


def moved(surface, place: Iterable, options: dict) -> Any:
    """The same dataclass with its tensors moved, as ``Tensor.to(*place, **options)`` moves one."""

    def to(value):
        if isinstance(value, tuple):
            return tuple(to(v) for v in value)
        return value.to(*place, **options) if namespace(value).name == "torch" else value

    return replace(surface, **{each.name: to(getattr(surface, each.name)) for each in fields(surface) if each.init})
