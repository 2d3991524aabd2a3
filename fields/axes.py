"""Directions of planes and vectors: the axis along which a vector runs, and the two that its plane spans."""

from __future__ import annotations

_AXES = {"x": (0, 1, 2), "y": (1, 0, 2), "z": (2, 0, 1)}


def axes_of(direction: str) -> tuple[int, int, int]:
    """Axes of the vector and of the plane's columns and rows, for a direction "x", "y" or "z"."""
    return _AXES[direction]
