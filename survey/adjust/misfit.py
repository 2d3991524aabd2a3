"""Reprojection misfit under fixed poses."""

from __future__ import annotations

import numpy as np

# Fewest windows of a photograph whose mean counts.
_FEWEST = 10


def misfit(residuals: np.ndarray, view: np.ndarray) -> float | None:
    """See `PoseCheck`: of residuals (N, 2) [px] of observations in photographs (N,)."""
    squares = []
    for number in np.unique(view):
        mine = residuals[(view == number) & np.isfinite(residuals).all(axis=1)]
        if len(mine) < _FEWEST:
            continue
        middle = np.median(mine, axis=0)
        # The variance of a median is pi / 2 times that of a mean.
        noise = np.square(1.4826 * np.median(np.abs(mine - middle), axis=0)) * (0.5 * np.pi / len(mine))
        squares.append(middle**2 - noise)
    return float(np.sqrt(max(float(np.mean(squares)), 0.0))) if squares else None
