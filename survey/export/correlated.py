"""Correlation area of the errors of neighbouring points, estimated from a cloud.

Least squares over photographs smooth a bed that is smooth more than one that is rough, so that the area differs from
survey to survey. Points whose heights differ by less than their standard deviations say must err alike: where
differences between points a distance apart have the variance D, the errors have a correlation of 1 - D / (s1² + s2²) at
least, as relief can only add to D.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

# Errors of neighbouring points are alike: so many points [px²] say as much as one, at least. Of rough beds 5 to 12.
LEAST_PX2 = 15.0
# Windows of a cloud that are looked at, how far they reach, and how many points of each [px].
_WINDOWS, _RADIUS_PX, _MOST_POINTS, _FEWEST_POINTS = 60, 9.0, 300, 60
# Farther apart than this, what is left of the relief in a window hides what errors have in common [px].
_REACH_PX = 4
# Squared differences count up to this many times their variance.
_LARGEST = 9.0
_SEED = 0


def correlated_px2(plan: np.ndarray, height: np.ndarray, std: np.ndarray, pixel: float) -> float:
    """The area [px²] over which points say as much as one.

    Parameters
    ----------
    plan : (N, 2) [m]
    height, std : (N,) [m]
    pixel : [m]
        What a pixel of the photographs covers.

    Returns
    -------
    float
        At least `LEAST_PX2`.
    """
    rng = np.random.default_rng(_SEED)
    tree = cKDTree(plan)
    squared, count = np.zeros((2, _REACH_PX))
    for middle in plan[rng.choice(len(plan), min(_WINDOWS, len(plan)), replace=False)]:
        near = np.sort(tree.query_ball_point(middle, _RADIUS_PX * pixel))
        if len(near) < _FEWEST_POINTS:
            continue
        if len(near) > _MOST_POINTS:
            near = rng.choice(near, _MOST_POINTS, replace=False)
        x, y = ((plan[near] - middle) / pixel).T
        rest = _less_relief(x, y, height[near].astype(np.float64))
        i, j = np.triu_indices(len(near), 1)
        apart = np.hypot(x[i] - x[j], y[i] - y[j])
        close = apart < _REACH_PX
        i, j, ring = i[close], j[close], apart[close].astype(np.int64)
        variance = np.square(std[near].astype(np.float64))
        share = np.minimum((rest[i] - rest[j]) ** 2 / (variance[i] + variance[j]), _LARGEST)
        squared += np.bincount(ring, share, _REACH_PX)
        count += np.bincount(ring, minlength=_REACH_PX)
    alike = np.maximum(1.0 - squared / np.maximum(count, 1.0), 0.0) * (count > 0)
    rings = np.pi * np.diff(np.arange(_REACH_PX + 1) ** 2)
    return max(float(alike @ rings), LEAST_PX2)


def _less_relief(x: np.ndarray, y: np.ndarray, height: np.ndarray) -> np.ndarray:
    """Heights (N,) [m] less a surface of second degree."""
    design = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y])
    return height - design @ np.linalg.lstsq(design, height, rcond=None)[0]
