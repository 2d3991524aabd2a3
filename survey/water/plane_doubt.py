"""Test whether a plane fits points of the water: departure from it as error of the bed, against its std.

Polynomials on top of the plane are fitted to either half of the points. What both halves show alike is a departure; the
scatter of points, and a single wrong one, are not in both. The mean product of the two is its square without bias.
"""

from __future__ import annotations

import numpy as np
from scipy.special import fdtrc

from survey.display.quantities import length

# Fewer points determine no more than a plane.
_LEAST_POINTS, _ENOUGH_FOR_ALL = 16, 32
# Significance: share of sets of points on a plane that seem to depart from it by their scatter alone.
_FALSE_ALARMS = 1e-3
# Nearer to the vertical than this the bed moves by n - 1 of an error of the level, and more for oblique rays.
_BED_PER_LEVEL = 0.333
# Huber's constant, and the median of the absolute value of a normal deviate.
_HUBER, _MEDIAN_DEVIATION = 1.345, 0.6745
_ROUNDS = 20
# Narrower points, as a share of their length, are a line.
_LINE = 0.1


def plane_doubt(points: np.ndarray, stds: np.ndarray, level_std_m: float, source: str) -> str | None:
    """Warning where points (N, 3) [m] on the water depart from a plane by more than the std of its level.

    Parameters
    ----------
    points : (N, 3) [m]
    stds : (N,) [m]
        Weights.
    level_std_m : [m]
        Of the level that is stated for the plane.
    source : str
        The key of [water].
    """
    departure = departure_of(points, stds)
    if departure is None or departure <= level_std_m:
        return None
    bed, stated = (length(_BED_PER_LEVEL * value) for value in (departure, level_std_m))
    return (
        f"one plane is not enough for the water: the points in [water] {source} depart from it by {length(departure)} "
        f"(rms), far above their scatter, which moves the bed by {bed} or more, where the std of the level stands for "
        f"{stated}; give them as surface in place of {source} (docs/waterline.md)"
    )


def departure_of(points: np.ndarray, stds: np.ndarray) -> float | None:
    """Root mean square [m] by which a surface through points departs from a plane; None where they show none."""
    if len(points) < _LEAST_POINTS:
        return None
    flat, bent = _designs(points[:, :2])
    # What is left of the polynomials beside the plane, for weights of all points.
    bent = bent - flat @ np.linalg.lstsq(flat, bent, rcond=None)[0]
    design, num_bent = np.column_stack([flat, bent]), bent.shape[1]
    if np.linalg.matrix_rank(design) < design.shape[1]:
        # Readings at a few places.
        return None
    values, weights = _robust(design, points[:, 2], stds)
    residuals = (points[:, 2] - design @ values) / stds
    spare = len(points) - design.shape[1]
    # The median is a poor estimate of the scatter of few points, the mean square of that of many with wrong ones.
    by_median = float(np.median(np.abs(residuals))) / _MEDIAN_DEVIATION * np.sqrt(len(points) / spare)
    std = max(by_median, float(np.sqrt(np.sum(weights * residuals**2) / spare)), 1e-9)
    root = np.sqrt(weights) / stds
    covariance = np.linalg.inv((design * root[:, None]).T @ (design * root[:, None]))[-num_bent:, -num_bent:]
    ratio = values[-num_bent:] @ np.linalg.solve(covariance, values[-num_bent:]) / num_bent / std**2
    if fdtrc(num_bent, spare, ratio) > _FALSE_ALARMS:
        return None
    order = np.argsort(points[:, :2] @ _main_axis(points[:, :2]))
    halves = [
        bent @ _robust(design[half], points[half, 2], stds[half])[0][-num_bent:] for half in (order[::2], order[1::2])
    ]
    return float(np.sqrt(max(np.mean(halves[0] * halves[1]), 0.0))) or None


def _designs(xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Terms of a plane (N, 2 or 3), and of a surface on top of it (N, K): along the points, and across where wide."""
    axis = _main_axis(xy)
    around = xy - xy.mean(axis=0)
    along, across = around @ axis, around @ (-axis[1], axis[0])
    half = np.abs(along).max()
    s, t = along / half, across / half
    many = len(xy) >= _ENOUGH_FOR_ALL
    bent = [s**2, s**3, *([s**4, s**5] if many else [])]
    if np.std(t) < _LINE * np.std(s):
        return np.column_stack([np.ones(len(s)), s]), np.column_stack(bent)
    return np.column_stack([np.ones(len(s)), s, t]), np.column_stack([*bent, *([s * t, t**2] if many else [])])


def _main_axis(xy: np.ndarray) -> np.ndarray:
    return np.linalg.svd(xy - xy.mean(axis=0), full_matrices=False)[2][0]


def _robust(design: np.ndarray, heights: np.ndarray, stds: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Huber's estimate and its weights (N,), in units of the scatter."""
    weights = np.ones(len(heights))
    for _ in range(_ROUNDS):
        root = np.sqrt(weights) / stds
        values = np.linalg.lstsq(design * root[:, None], heights * root, rcond=None)[0]
        rest = np.abs(heights - design @ values) / stds
        scatter = max(float(np.median(rest)) / _MEDIAN_DEVIATION, 1e-9)
        weights = np.minimum(1.0, _HUBER * scatter / np.maximum(rest, 1e-12))
    return values, weights
