"""Height of a cloud at places in plan, by a plane through its points around each."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 12
# Fewer do not determine a plane against noise.
_FEWEST = 4
# A place whose neighbours all lie to one side is beyond the rim. Their centre may be off by this share of the distance
# of the farthest. A place in the corner of an even cloud has 0.6, one on a straight rim 0.42.
_MOST_OFF = 0.5


def height_at(cloud: np.ndarray, places: np.ndarray, *, within_m: float = 1.0) -> np.ndarray:
    """Height of a cloud at places in plan.

    Parameters
    ----------
    cloud : (N, 3) [m]
        Cartesian frame, z up; points that are not finite are left out.
    places : (K, 2) [m]
    within_m : float [m]
        Points farther off in plan do not count.

    Returns
    -------
    (K,) [m]
        Value at the place of the plane that fits its twelve nearest points in plan best, in heights and by least
        squares; NaN where there are fewer than four, they lie on a line, or all to one side.
    """
    heights = np.full(len(places), np.nan)
    cloud = cloud[np.isfinite(cloud).all(axis=1)]
    if not len(cloud):
        return heights
    tree = cKDTree(cloud[:, :2])
    distances, numbers = tree.query(places, k=min(_NEIGHBOURS, len(cloud)), distance_upper_bound=within_m)
    for i, (distance, number) in enumerate(zip(np.atleast_2d(distances.T).T, np.atleast_2d(numbers.T).T, strict=True)):
        near = number[np.isfinite(distance)]
        if len(near) >= _FEWEST:
            heights[i] = _plane_at(cloud[near] - [*places[i], 0.0])
    return heights


def _plane_at(points: np.ndarray) -> float:
    """Height at the origin of the plane that fits points (M, 3); NaN where they do not surround it."""
    centre = points[:, :2].mean(axis=0)
    farthest = float(np.linalg.norm(points[:, :2], axis=1).max())
    if np.linalg.norm(centre) > _MOST_OFF * farthest:
        return np.nan
    design = np.column_stack([np.ones(len(points)), points[:, :2]])
    solution, _, rank, _ = np.linalg.lstsq(design, points[:, 2], rcond=1e-6)
    return float(solution[0]) if rank == 3 else np.nan
