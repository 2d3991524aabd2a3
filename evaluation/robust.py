"""Robust estimates: the standard deviation by the median, and Huber's weights."""

from __future__ import annotations

import numpy as np

# Standard deviation of a normal distribution over its median absolute deviation.
MAD_TO_STD = 1.4826
# Huber's bound [standard deviations]: 95 % of good residuals lie within (P. J. Huber, Annals of Mathematical Statistics
# 35(1), 1964).
HUBER = 2.0
# The same for a few numbers of many observations, of which a tenth may be wrong: an efficiency of 95 % where errors are
# normal, and half the error that a bound of 2.0 leaves of such outliers.
HUBER_OF_MANY = 1.345


def std_by_median(residuals: np.ndarray, axis: int | None = None):
    """Standard deviation of residuals about zero, from the median of their absolute values."""
    return MAD_TO_STD * np.median(np.abs(residuals), axis=axis)


def huber_weights(length: np.ndarray, std: np.ndarray | float = 1.0, bound: float = HUBER) -> np.ndarray:
    """Huber's weights [-] of residuals of a length and a standard deviation: 1 within the bound, falling beyond."""
    return np.minimum(1.0, bound * std / np.maximum(length, 1e-300))
