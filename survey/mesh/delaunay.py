"""2.5D surfaces: the surest point of each cell in plan, and Delaunay triangles between them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import Delaunay, QhullError

# Longer sides of triangles, in plan and in spacings, bridge a hole of the cloud.
LONGEST = 6.0


def delaunay_surface(points: np.ndarray, std: np.ndarray, spacing_m: float) -> tuple[np.ndarray, np.ndarray]:
    """One height at each place in plan: for beds without overhangs.

    Parameters
    ----------
    points : (N, 3) [m]
    std : (N,) [m]
        Of each cell the point with the smallest one stays. A mean over the cell would be smoother, and wrong at every
        step of the bed, where it takes points of both sides.
    spacing_m : [m]
        Side of the cells.

    Returns
    -------
    vertices : (V, 3) [m]
        Points of the cloud.
    faces : (F, 3) int
        Without those that have a side of more than `LONGEST` spacings in plan.
    """
    chosen = points[_surest(points, std, spacing_m)]
    try:
        # Qhull loses digits where coordinates are large.
        triangles = Delaunay(chosen[:, :2] - chosen[:, :2].mean(axis=0)).simplices
    except (QhullError, ValueError):  # fewer than three points, or all on one line
        return chosen, np.zeros((0, 3), dtype=np.int64)
    sides = np.linalg.norm((chosen[triangles] - chosen[np.roll(triangles, 1, axis=1)])[..., :2], axis=2)
    return without_loose(chosen, triangles[sides.max(axis=1) < LONGEST * spacing_m])


def _surest(points: np.ndarray, std: np.ndarray, cell_m: float) -> np.ndarray:
    """Numbers of the points with the smallest std of their cells."""
    column, row = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / cell_m).astype(np.int64).T
    cell = row * (column.max() + 1) + column
    order = np.lexsort((np.where(np.isfinite(std), std, np.inf), cell))
    ordered = cell[order]
    return order[np.append(True, ordered[1:] != ordered[:-1])]


def without_loose(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The mesh without vertices that no face has."""
    used, numbers = np.unique(faces, return_inverse=True)
    return vertices[used], numbers.reshape(-1, 3).astype(np.int64)
