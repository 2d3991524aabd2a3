"""Points binned into the cells of a raster in plan: their numbers row by row, counts and means."""

from __future__ import annotations

import numpy as np


def cell_numbers(at: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cell (N,) int64 of each point, row by row; -1 beyond the raster and for NaN.

    Parameters
    ----------
    at : (N, 2) [cells]
        Column and row, from the outer corner of the first cell.
    shape : (rows, columns)
    """
    floor = np.floor(at)
    inside = ((floor >= 0) & (floor < np.array(shape[::-1]))).all(axis=1)
    column, row = np.where(inside[:, None], floor, 0.0).astype(np.int64).T
    return np.where(inside, row * shape[1] + column, -1)


def cell_counts(number: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Points in each cell (rows, columns), from the cell (N,) of each; -1 is none."""
    return np.bincount(number[number >= 0], minlength=shape[0] * shape[1]).reshape(shape)


def cell_means(number: np.ndarray, values: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Mean of values (N,) in each cell (rows, columns), NaN where there is none; values that are NaN do not count."""
    use = (number >= 0) & np.isfinite(values)
    count = cell_counts(number[use], shape)
    total = np.bincount(number[use], weights=values[use].astype(np.float64), minlength=count.size).reshape(shape)
    return np.where(count == 0, np.nan, total / np.maximum(count, 1))
