"""Correlated errors of neighbouring tie points in one photograph: waves, relief and lens residuals.

Matches near each other in a photograph look through the same wave and lie on the same relief, so that their errors are
alike and hundreds of them say less than as many independent ones. In a square of a photograph with m observations whose
errors correlate by rho, the variance of their mean is ``(1 + (m - 1) rho) / m`` of that of one (the design effect of
cluster samples, L. Kish, Survey Sampling, 1965, section 5.4).
"""

from __future__ import annotations

import numpy as np

from survey.photos.tie_points import TiePoints

# Sides of the squares, as shares of the longer side of a photograph: the one in which most is shared counts.
_SIDES = (0.04, 0.08, 0.16)
# Residuals of more standard deviations count as that many.
_MOST = 3.0


def inflation(ties: TiePoints, residuals: np.ndarray, std_px: np.ndarray, kind: np.ndarray, sizes) -> np.ndarray:
    """Factors (N,), at least 1, on the variances of observations.

    Parameters
    ----------
    ties : TiePoints
    residuals : (N, 2) [px]
    std_px : (kinds,) [px]
        Standard deviation of a pixel coordinate of each kind.
    kind : (N,)
        Each kind has one factor.
    sizes : (width, height) [px] of each photograph
    """
    length = np.linalg.norm(residuals, axis=1, keepdims=True)
    bound = _MOST * std_px[kind][:, None]
    normal = residuals * np.minimum(1.0, bound / np.maximum(length, 1e-12)) / std_px[kind][:, None]
    side = np.array([max(size) for size in sizes], dtype=np.float64)[ties.view]
    out = np.ones(len(kind))
    for number in range(len(std_px)):
        mine = kind == number
        if mine.any():
            found = [_design_effect(ties.view[mine], ties.pixel[mine], normal[mine], s * side[mine]) for s in _SIDES]
            out[mine] = max(1.0, *found)
    return out


def _design_effect(view: np.ndarray, pixel: np.ndarray, normal: np.ndarray, side: np.ndarray) -> float:
    cells = np.column_stack([view, np.floor(pixel / side[:, None])])
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell).astype(np.float64)
    pairs = float((count * (count - 1.0)).sum())
    if pairs == 0.0:
        return 1.0
    sums = np.stack([np.bincount(cell, weights=axis) for axis in normal.T], axis=-1)
    square = float(np.sum(normal**2))
    correlation = (float(np.sum(sums**2)) - square) / (pairs * square / len(normal))
    return 1.0 + (float((count**2).sum() / count.sum()) - 1.0) * max(correlation, 0.0)
