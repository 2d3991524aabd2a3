"""Propagation of covariance: J C Jᵀ of a linear function of unknowns, whose derivatives are J."""

from __future__ import annotations

import numpy as np


def propagated(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance (..., K, K) of functions whose derivatives (..., K, P) are by unknowns of a covariance (P, P)."""
    return jacobian @ covariance @ jacobian.swapaxes(-1, -2)


def propagated_variance(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Variances (..., K) alone, as `propagated`; rounding leaves none below zero."""
    return np.maximum(np.sum((jacobian @ covariance) * jacobian, axis=-1), 0.0)
