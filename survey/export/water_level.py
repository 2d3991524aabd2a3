"""Height of the water in crs, for rasters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# A plane of the local frame is one in crs but for the curvature of the Earth and of the map: a paraboloid.
_MOST_POINTS = 20_000


@dataclass(frozen=True)
class LevelFit:
    """A paraboloid through the water over the points of a cloud.

    Attributes
    ----------
    middle, extent : (2,) in crs
    coefficients : (6,) [m]
        Of 1, x, y, x x, x y, y y, with x and y from the middle in extents.
    """

    middle: np.ndarray
    extent: np.ndarray
    coefficients: np.ndarray

    @staticmethod
    def of(points: np.ndarray, depth: np.ndarray) -> LevelFit | None:
        """Of points (N, 3), in crs with heights in metres, and their depths (N,) [m]; None where none has a depth."""
        known = np.flatnonzero(np.isfinite(depth))
        if not len(known):
            return None
        some = known[:: len(known) // _MOST_POINTS + 1]
        plan, level = points[some, :2], points[some, 2] + depth[some]
        middle, extent = plan.mean(axis=0), np.maximum(np.ptp(plan, axis=0), 1e-9)
        base = float(level.mean())
        coefficients, *_ = np.linalg.lstsq(_terms((plan - middle) / extent), level - base, rcond=1e-9)
        coefficients[0] += base
        return LevelFit(middle, extent, coefficients)

    def __call__(self, plan: np.ndarray) -> np.ndarray:
        """Height of the water [m] (...) at places (..., 2) in crs."""
        return _terms((plan - self.middle) / self.extent) @ self.coefficients


def _terms(plan: np.ndarray) -> np.ndarray:
    x, y = plan[..., 0], plan[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
