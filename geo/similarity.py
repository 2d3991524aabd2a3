"""Similarity transforms: b = s R a + t, fitted to points by least squares, also where up to half of them are wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

_MIN_POINTS = 3
_DRAWS = 500
# Median length of a vector of three unit normals: the root of the median of chi-square with 3 degrees of freedom.
_MEDIAN_LENGTH = 1.538
# The parameters of a similarity.
_PARAMETERS = 7
# A position is a gross error beyond this many std, or, where few points determine the std, beyond the quantile of one
# in a million. Residuals of deformed blocks have longer tails than noise, so the limits are wide, and never below the
# difference between a fixed and a float RTK solution.
_WRONG_STD, _WRONG_PROBABILITY, _WRONG_AT_LEAST_M = 6.0, 1e-6, 0.6


@dataclass(frozen=True)
class Similarity:
    """``b = scale * rotation @ a + shift``."""

    scale: float  # [-]
    rotation: np.ndarray  # (3, 3)
    shift: np.ndarray  # (3,)

    def __call__(self, points) -> np.ndarray:
        """Points (..., 3) of a in b."""
        return self.scale * np.asarray(points) @ self.rotation.T + self.shift


def fit_similarity(a, b) -> Similarity:
    """The similarity that takes points a (N, 3) to b (N, 3) with the least sum of squared distances.

    Notes
    -----
    Umeyama 1991, "Least-squares estimation of transformation parameters between two point patterns",
    equations 34 to 43; never a reflection.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    from_a, from_b = a - mean_a, b - mean_b
    u, lengths, vt = np.linalg.svd(from_b.T @ from_a)
    signs = np.array([1.0, 1.0, math.copysign(1.0, np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((lengths * signs).sum() / (from_a**2).sum())
    return Similarity(scale, rotation, mean_b - scale * rotation @ mean_a)


def robust_similarity(a, b) -> tuple[Similarity, np.ndarray]:
    """Fit a similarity robustly: up to half of the points may be wrong.

    Returns
    -------
    Similarity
        Fitted to all points that agree.
    (N,) bool
        The points that agree.

    Notes
    -----
    Least median of squares over seeded samples of three points (Rousseeuw 1984, "Least median of squares
    regression"), which needs no threshold; then fits to the points within `gross_error_limit`, while these change.
    """
    a, b = np.asarray(a, dtype=np.float64), np.asarray(b, dtype=np.float64)
    if len(a) < _MIN_POINTS:
        raise ValueError(f"a similarity needs {_MIN_POINTS} points, got {len(a)}")
    best = fit_similarity(a, b)
    least = np.median(_distances(best, a, b))
    rng = np.random.default_rng(0)
    for _ in range(_DRAWS if len(a) > _MIN_POINTS else 0):
        pick = rng.choice(len(a), _MIN_POINTS, replace=False)
        trial = fit_similarity(a[pick], b[pick])
        median = np.median(_distances(trial, a, b))
        if median < least:
            best, least = trial, median
    agree = np.zeros(len(a), dtype=bool)
    # Two or three rounds are usual; the limit ends an oscillation between two sets.
    for _ in range(20):
        distances = _distances(best, a, b)
        wrong = gross_error_limit(float(np.median(distances)), max(int(agree.sum()), len(a) // 2 + 1, _MIN_POINTS))
        before, agree = agree, distances <= wrong
        if (agree == before).all() or agree.sum() < _MIN_POINTS:
            break
        best = fit_similarity(a[agree], b[agree])
    return best, agree


def gross_error_limit(median: float, num: int) -> float:
    """Distance [m] beyond which a point is a gross error of a similarity fitted to consistent points, three at least.

    By the median of the distances of all points [m]: six times the standard deviation that it gives, at least the limit
    by Student's distribution with the degrees of freedom that remain (three points leave two of nine, and may fit well
    by chance), and never below 0.6 m.
    """
    free = 3 * num - _PARAMETERS
    spread = median / _MEDIAN_LENGTH * math.sqrt(3 * num / free)
    return max(max(_WRONG_STD, -float(stdtrit(free, 0.5 * _WRONG_PROBABILITY))) * spread, _WRONG_AT_LEAST_M)


def _distances(similarity: Similarity, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.linalg.norm(similarity(a) - b, axis=1)
