"""What several benchmarks do with points: thin them out, and see them from above."""

from __future__ import annotations

import numpy as np


def thinned(points: np.ndarray, cell: float) -> np.ndarray:
    """One point, the first, of each cube of that edge [m], in their order."""
    _, first = np.unique(np.floor(points / cell).astype(np.int64), axis=0, return_index=True)
    return points[np.sort(first)]


def tops(points: np.ndarray, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Greatest heights (rows, columns) of points (N, 3) in square cells [m], and row and column (N,) of each point.

    Cells without points are -inf.
    """
    column, row = np.floor((points[:, :2] - points[:, :2].min(axis=0)) / cell).astype(np.int64).T
    top = np.full((row.max() + 1, column.max() + 1), -np.inf)
    np.maximum.at(top, (row, column), points[:, 2])
    return top, row, column
