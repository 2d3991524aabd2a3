"""Displacement of points of the bed by waves, in the frame of the water: z is the height over its plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refract import kernels

# Waves over shallower water [m] displace by less than is measured.
LEAST_DEPTH = 0.1
_STEPS = 2
_LEVEL = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Crossings:
    """Where rays from a camera to N points cross the plane, and how the points are displaced by a surface there.

    With the gradient g of the surface and its height s a point is displaced by
    ``depth (across g + along (along . g) curve) + by_height s``.
    """

    place: np.ndarray  # (2, N) [m]
    depth: np.ndarray  # (N,) [m]; 0 on dry ground
    across: np.ndarray  # (N,)
    along: np.ndarray  # (2, N): horizontal part of the direction in air
    curve: np.ndarray  # (N,)
    by_height: np.ndarray  # (2, N)

    @staticmethod
    def of(centre: np.ndarray, points: np.ndarray, n_water: float) -> Crossings:
        """Of a camera (3,) and points (3, N) [m]."""
        plane = kernels.WaterPlane(*_LEVEL, n_water)
        crossing, depth = kernels.crossing_of_point(tuple(np.float32(c) for c in centre), tuple(points), plane, _STEPS)
        depth = np.maximum(depth, np.float32(0.0))
        place = np.stack(crossing[:2])
        air = place - np.asarray(centre[:2], dtype=np.float32)[:, None]
        height = np.float32(centre[2])
        length = np.sqrt((air**2).sum(axis=0) + height**2)
        along, cosine = air / length, height / length
        in_water = np.sqrt(1.0 - (1.0 - cosine**2) / n_water**2)
        bend = cosine / n_water - in_water
        across = (bend / in_water).astype(np.float32)
        curve = -(1.0 / n_water - cosine / (n_water**2 * in_water)) / (n_water * in_water**2)
        wet = depth > 0.0
        by_height = np.where(wet, air / height - along / (n_water * in_water), np.float32(0.0))
        return Crossings(place, depth, across, along, curve.astype(np.float32), by_height)

    def displacement(self, height: np.ndarray, gradient: np.ndarray) -> np.ndarray:
        """Displacement (2, N) [m] by heights (N,) [m] and gradients (2, N) of a surface at the places."""
        turned = self.across * gradient + self.along * (self.curve * (self.along * gradient).sum(axis=0))
        return self.depth * turned + self.by_height * height

    @property
    def by_gradient(self) -> np.ndarray:
        """Change of the displacement (2, 2, N) [m] with the gradient."""
        return self.depth * (self.across * np.eye(2)[..., None] + self.curve * self.along[:, None] * self.along[None])
