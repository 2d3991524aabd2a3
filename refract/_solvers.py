"""Registry of solvers and of the surfaces they solve, by name: each is one operator in torch's graph.

Solvers work in numpy and give no derivatives; their callers attach those at the root (`refract._implicit`).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

# By name: the number of arrays that a solver returns, with the solver; and the constructor of a surface from numbers.
SOLVERS: dict[str, tuple[int, Callable[..., tuple]]] = {}
SURFACES: dict[str, Callable[..., Any]] = {}


def solver(outputs: int):
    """Decorator of a function of a surface and numpy arrays (...) that returns `outputs` arrays (...)."""

    def register(function):
        SOLVERS[function.__name__] = outputs, function
        return function

    return register


def solved(surface: type) -> type:
    """Decorator of a surface that its `numbers` define: ``from_numbers(*numbers)`` is the same surface."""
    SURFACES[surface.__name__] = surface.from_numbers  # type: ignore[attr-defined]
    return surface
