"""The numbers of a water surface: plain ones, or arrays of any library, which may carry gradients."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import fields, replace
from typing import Any

import numpy as np

from refract._array import as_like, as_numpy, namespace, solve, transformed


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


def hold(condition: Callable[[np.ndarray], np.ndarray], *numbers) -> bool:
    """Whether a condition holds for all values; taken to, while a transform of torch hides what tensors hold."""
    if transformed():
        return True
    return all(bool(condition(as_numpy(value)).all()) for value in numbers)


def least(*numbers):
    """The smallest of numbers, some of which may be tensors that cannot be read."""
    smallest = numbers[0]
    for value in numbers[1:]:
        both = namespace(smallest, value)
        smallest = min(smallest, value) if both.name == "numpy" else both.minimum(smallest, value)
    return smallest


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


def mapped(surface, change: Callable[[Any], Any]) -> Any:
    """The same dataclass with its tensors changed."""

    def to(value):
        if isinstance(value, tuple):
            return tuple(to(v) for v in value)
        return change(value) if namespace(value).name == "torch" else value

    return replace(surface, **{each.name: to(getattr(surface, each.name)) for each in fields(surface) if each.init})


def moved(surface, place: Iterable, options: dict) -> Any:
    """The same dataclass with its tensors moved, as ``Tensor.to(*place, **options)`` moves one."""
    return mapped(surface, lambda tensor: tensor.to(*place, **options))


def read(solver: Callable, surface, arrays: tuple) -> tuple:
    """What a solver of `refract._solvers` makes of a surface and arrays of one shape, in their library.

    Without derivatives. Under a transform of torch it is called where the values can be read.
    """
    if transformed() and namespace(*arrays).name == "torch":
        return solve(solver.__name__, type(surface).__name__, surface.numbers, arrays)
    found = solver(surface.detached(), *(as_numpy(array) for array in arrays))
    return tuple(as_like(each, arrays[0]) for each in found)
