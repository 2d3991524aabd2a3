"""Solvers on values, and the surfaces they solve, by name: one operator of torch's graph for each.

Solvers work in numpy and give no derivatives; their callers attach those at the root (`refract._implicit`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# How many arrays a solver gives, and the solver; a surface from its numbers. By their names.
SOLVERS: dict[str, tuple[int, Callable[..., tuple]]] = {}
SURFACES: dict[str, Callable[..., Any]] = {}


def solver(outputs: int):
    """Decorator of a function of a surface and arrays of numpy (...), which gives `outputs` arrays (...)."""

    def register(function):
        SOLVERS[function.__name__] = outputs, function
        return function

    return register


def solved(surface: type) -> type:
    """Decorator of a surface whose `numbers` are all of it: ``from_numbers(*numbers)`` is the same one."""
    SURFACES[surface.__name__] = surface.from_numbers  # type: ignore[attr-defined]
    return surface
