"""Water surfaces. A flat surface is a plane with an index below it; others will share its small interface."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class FlatWater:
    """A plane water surface, level or tilted, in a right-handed frame with z up.

    Parameters
    ----------
    point : (3,) [m], local
        Any point of the surface.
    n_water : [-]
        Refractive index of the water relative to the air above it, at least 1.
    slope_x, slope_y : [-]
        Rise of the surface per metre along local x and y.

    Raises
    ------
    ValueError
        If the index is outside 1 to 2, or a number is not finite.
    """

    point: tuple[float, float, float]
    n_water: float = 1.333
    slope_x: float = 0.0
    slope_y: float = 0.0

    def __post_init__(self):
        object.__setattr__(self, "point", tuple(float(v) for v in self.point))
        numbers = (*self.point, self.n_water, self.slope_x, self.slope_y)
        if len(self.point) != 3 or not all(math.isfinite(v) for v in numbers):
            raise ValueError(f"expected three finite coordinates, a finite index and two finite slopes, got {numbers}")
        if not 1.0 <= self.n_water <= 2.0:
            raise ValueError(f"expected an index of water relative to air of 1 to 2 (fresh: 1.333), got {self.n_water}")

    @property
    def normal(self) -> tuple[float, float, float]:
        """Unit normal of the surface, pointing up into the air, local."""
        length = math.sqrt(1.0 + self.slope_x**2 + self.slope_y**2)
        return (-self.slope_x / length, -self.slope_y / length, 1.0 / length)

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]."""
        return self.point[2] + self.slope_x * (x - self.point[0]) + self.slope_y * (y - self.point[1])

    def depth(self, points):
        """Depth below the surface [m] along its normal, positive in water, of points (..., 3) [m], local."""
        nx, ny, nz = self.normal
        px, py, pz = self.point
        return -((points[..., 0] - px) * nx + (points[..., 1] - py) * ny + (points[..., 2] - pz) * nz)

    def as_array(self) -> np.ndarray:
        """Point, normal and index as (7,) float64, the form that compiled kernels take."""
        return np.array([*self.point, *self.normal, self.n_water], dtype=np.float64)
