"""Robust adjustment: Huber's loss and weights, and standard deviations of kinds of observations from their residuals.

Residuals are in units of the standard deviation of their kind (P. J. Huber, Annals of Mathematical Statistics 35(1),
1964).
"""

from __future__ import annotations

import numpy as np

from survey.adjust.block.problem import Problem

# Huber's bound [standard deviations]: 95 % of good residuals lie within.
HUBER = 2.0
# The median of the length of a two-dimensional normal deviate of unit standard deviation per axis, sqrt(2 ln 2).
_MEDIAN_LENGTH = 1.1774
# Of two photographs residuals lie across epipolar lines: that of a deviate along one axis with the same mean square.
_MEDIAN_OF_TWO = 0.9539


def huber_loss(length: np.ndarray) -> np.ndarray:
    """Huber's loss of residuals of a length in standard deviations: the square within the bound, linear beyond."""
    return np.where(length < HUBER, length**2, HUBER * (2.0 * length - HUBER))


def std_of_kinds(problem: Problem, residuals: np.ndarray, taken: float) -> np.ndarray:
    """Standard deviation [px] of a coordinate of each kind of observation, from the median of its residuals.

    Parameters
    ----------
    residuals : (N, 2) [px]
    taken : float
        How many coordinates the parameters take.
    """
    length = np.linalg.norm(residuals, axis=1)
    # Each point takes three of the coordinates that its observations have.
    seen = np.bincount(problem.ties.point, minlength=len(problem.ties))[problem.ties.point]
    left = 1.0 - taken / max(2 * len(problem.kind) - 3 * len(problem.ties), 1)
    spare = np.sqrt(np.maximum((1.0 - 1.5 / seen) * left, 0.1))
    spare = np.where(seen == 2, _MEDIAN_OF_TWO / _MEDIAN_LENGTH, 1.0) * spare
    std = problem.given_std_px.copy()
    present = np.bincount(problem.kind, minlength=len(std)) > 0
    # Of a kind that was not observed, any number does.
    std[~present & np.isnan(std)] = 1.0
    for kind in np.flatnonzero(np.isnan(std)):
        scaled = (length / spare)[(problem.kind == kind) & np.isfinite(length)]
        std[kind] = max(float(np.median(scaled)) / _MEDIAN_LENGTH, 1e-3) if len(scaled) else 1.0
    return std


def huber_weights(problem: Problem, residuals: np.ndarray, std_px: np.ndarray) -> np.ndarray:
    """Huber weights (N,) [1/px^2]; zero where there is no residual."""
    std, length = std_px[problem.kind], np.linalg.norm(residuals, axis=1)
    weights = np.minimum(1.0, HUBER * std / np.maximum(length, 1e-300)) / std**2
    return np.where(np.isfinite(length), weights, 0.0)
