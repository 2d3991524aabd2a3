"""Planes of an earlier survey of the ground on which tie points lie, in the normal equations of an adjustment.

With e the shift of the earlier survey, n the normal of a plane, h its height and s its strength, a point X adds
``s d^2`` with ``d = n . (X - e) - h`` to the sum of squares.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Planes:
    """Planes on which points are known to lie."""

    normal: np.ndarray  # (M, 3): Upwards, with 1 in z: the distance is along the vertical
    height: np.ndarray  # (M,) [m]: of ``normal . point`` on the plane.
    strength: np.ndarray  # (M,) [1/m^2]: inverse variance of that distance; 0 for points of which nothing is known

    def distances(self, points: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Vertical distances (M,) [m] of points (M, 3) above their planes shifted by (3,); 0 where there is none."""
        off = np.einsum("mi,mi->m", self.normal, points - shift) - self.height
        return np.where(self.strength > 0.0, off, 0.0)

    def squares(self, points: np.ndarray, shift: np.ndarray) -> float:
        """The sum of squares of the distances, in units of variances."""
        return float(self.strength @ self.distances(points, shift) ** 2)

    def of_points(self, points: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Contribution to the normal matrices (M, 3, 3) and right sides (M, 3) of the points.

        The shift has the sums of both over the points, with the sign of the right sides reversed; the normal matrices
        of a point and the shift are those of the points with the sign reversed.
        """
        along = self.strength[:, None] * self.normal
        return along[:, :, None] * self.normal[:, None, :], -along * self.distances(points, shift)[:, None]
