"""Apparent depth in closed form: what straight rays make of a bed under flat water.

``angle`` is the incidence in air [rad]; heights and depths in metres. Numpy, torch or plain floats.

Two cameras on opposite sides at equal incidence (any symmetric ring) see the *sagittal* image straight above
the point; cameras in one vertical plane through the point see the *tangential* image on the caustic. A real
network of views lies between the two, and always above the bed: straight rays make the bed too shallow.
"""

from __future__ import annotations

from refract._array import alike, namespace
from refract._empty import of_any_size


@of_any_size
def apparent_depth(depth, angle, *, n_water: float):
    """Sagittal apparent depth [m]: ``h cos(a) / sqrt(n^2 - sin^2 a)``; ``h / n`` at nadir."""
    depth, angle = alike(depth, angle)
    xp = namespace(depth, angle)
    return depth * xp.cos(angle) / xp.sqrt(n_water**2 - xp.sin(angle) ** 2)


@of_any_size
def true_depth(apparent, angle, *, n_water: float):
    """Inverse of `apparent_depth`: true depth [m] of a point whose sagittal image lies at `apparent` [m]."""
    apparent, angle = alike(apparent, angle)
    xp = namespace(apparent, angle)
    return apparent * xp.sqrt(n_water**2 - xp.sin(angle) ** 2) / xp.cos(angle)


@of_any_size
def apparent_depth_tangential(depth, angle, *, n_water: float):
    """Tangential apparent depth [m]: ``h n^2 cos^3(a) / (n^2 - sin^2 a)^(3/2)``."""
    depth, angle = alike(depth, angle)
    xp = namespace(depth, angle)
    return depth * n_water**2 * xp.cos(angle) ** 3 / (n_water**2 - xp.sin(angle) ** 2) ** 1.5


@of_any_size
def tangential_shift(depth, angle, *, n_water: float):
    """Shift [m] of the tangential image toward the camera: ``h (n^2 - 1) tan^3(angle in water)``."""
    depth, angle = alike(depth, angle)
    xp = namespace(depth, angle)
    sine = xp.sin(angle) / n_water
    return depth * (n_water**2 - 1.0) * (sine / xp.sqrt(1.0 - sine**2)) ** 3
