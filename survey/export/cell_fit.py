"""Heights of cells from the points in them: a plane by least squares in each, and how well its mean is known.

Each point has a standard deviation s. In a cell whose points scatter about their plane by more than that, the excess is
taken as relief of variance t², and a point's weight is 1 / (s² + t²): where a wall cuts the cell all points weigh
alike, as the mean over its area asks, and elsewhere a point that is badly known weighs little. Points that stand apart
from the others of their cell weigh less (P. Huber 1964). The slope of a plane is held by a weak prior, so that a cell
whose points lie on one side of it has a height, and a standard deviation that tells. Relief makes a mean uncertain only
as far as points do not sample it all over the cell.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Errors of neighbouring points are alike: so many points [px²] say as much as one. Over ten drawn surveys 6 to 20.
CORRELATED_PX = 15.0
# What is known beforehand of a slope: 45 degrees either way.
_SLOPE_STD = 1.0
# Beyond so many standard deviations a point weighs less.
_HUBER = 2.5
_STEPS = 3
_MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class CellFits:
    """Planes of M cells, those that have points, in the order of their numbers.

    Attributes
    ----------
    cell : (M,) int64
    height, std : (M,) float64 [m]
        Mean of the plane over the cell, which is its height in the middle, and its standard deviation.
    count : (M,) int64
        Points.
    """

    cell: np.ndarray
    height: np.ndarray
    std: np.ndarray
    count: np.ndarray


def fit_cells(
    cell: np.ndarray, offset: np.ndarray, height: np.ndarray, std: np.ndarray, *, side: float, pixel: float
) -> CellFits:
    """Fit a plane to the points of each cell.

    Parameters
    ----------
    cell : (N,) int64
        Number of the cell of each point.
    offset : (N, 2)
        East and north of each point from the middle of its cell, in sides: -0.5 to 0.5.
    height, std : (N,) [m]
    side, pixel : [m]
        Of a cell, and what a pixel of the photographs covers.
    """
    order = np.argsort(cell, kind="stable")
    cell, offset, height = cell[order], offset[order], height[order].astype(np.float64)
    variance = np.square(std[order].astype(np.float64))
    numbers, start, count = np.unique(cell, return_index=True, return_counts=True)
    row = np.repeat(np.arange(len(numbers)), count)
    base = _medians(height, row, start, count)
    height = height - base[row]
    share = _independent(count, side, pixel)[row] / count[row]
    unsampled = 1.0 - np.minimum(count * (pixel / side) ** 2, 1.0)
    relief, damping = np.zeros(len(numbers)), np.ones(len(height))
    for _ in range(_STEPS):
        weight = damping / (variance + relief[row])
        plane, _ = _planes(row, share * weight, offset, height, len(numbers), side)
        residual = height - plane[row, 0] - (plane[row, 1:] * offset).sum(axis=1)
        spread = _MAD_TO_STD * _medians(np.abs(residual), row, start, count)
        relief = np.maximum(spread**2 - np.bincount(row, damping * variance) / np.bincount(row, damping), 0.0)
        size = np.abs(residual) / np.sqrt(variance + relief[row])
        damping = np.minimum(1.0, _HUBER / np.maximum(size, _HUBER))
    weight = damping / (variance + (unsampled * relief)[row])
    _, plane_variance = _planes(row, share * weight, offset, height, len(numbers), side)
    return CellFits(numbers, base + plane[:, 0], np.sqrt(plane_variance), count)


def _independent(count: np.ndarray, side: float, pixel: float) -> np.ndarray:
    """As how many independent points those of a cell count: by the area that they cover, at most that of the cell."""
    covered = np.minimum((side / pixel) ** 2, count.astype(np.float64))
    return np.minimum(1.0 + covered / CORRELATED_PX, count)


def _medians(values: np.ndarray, row: np.ndarray, start: np.ndarray, count: np.ndarray) -> np.ndarray:
    """Median of each row's values, which lie side by side; the lower one of two."""
    return values[np.lexsort((values, row))][start + (count - 1) // 2]


def _planes(
    row: np.ndarray, weight: np.ndarray, offset: np.ndarray, height: np.ndarray, number: int, side: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted planes (M, 3), mean and rises across a cell to the east and north, and the variance (M,) of the mean."""
    columns = (np.ones(len(row)), offset[:, 0], offset[:, 1])
    normal, right = np.empty((number, 3, 3)), np.empty((number, 3))
    for i in range(3):
        weighted = weight * columns[i]
        right[:, i] = np.bincount(row, weighted * height, number)
        for j in range(i, 3):
            normal[:, i, j] = normal[:, j, i] = np.bincount(row, weighted * columns[j], number)
    normal[:, [1, 2], [1, 2]] += 1.0 / (_SLOPE_STD * side) ** 2
    inverse = np.linalg.inv(normal)
    return (inverse @ right[..., None])[..., 0], inverse[:, 0, 0]
