"""Heights of cells from the points in them: a plane by least squares in each, and how well its mean is known.

Each point has a standard deviation s. In a cell whose points scatter about their plane by more than that, the excess is
taken as relief of variance t², and a point's weight is 1 / (s² + t²): where a wall cuts the cell all points weigh
alike, as the mean over its area asks, and elsewhere a point that is badly known weighs little. Points that stand apart
from the others of their cell weigh less (P. Huber 1964). The slope of a plane is held by a weak prior, so that a cell
whose points lie on one side of it has a height, and a standard deviation that tells. Relief makes a mean uncertain only
as far as points do not sample it all over the cell. The part of a cell that has no points may lie off the plane by as
much as the bed rises and scatters where it has some; a cell of which points cover less than a third has no
height.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# What is known beforehand of a slope: 45 degrees either way.
_SLOPE_STD = 1.0
# Beyond so many standard deviations a point weighs less.
_HUBER = 2.5
# A cell is divided into squares, at most so many along a side; those with points are covered.
_MOST_SQUARES = 4
_LEAST_COVERED = 1.0 / 3.0
_STEPS = 3
_MAD_TO_STD = 1.4826


@dataclass(frozen=True)
class CellFits:
    """Planes of M cells, those that points cover well enough, in the order of their numbers.

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
    cell: np.ndarray, offset: np.ndarray, height: np.ndarray, std: np.ndarray,
    *, side: float, pixel: float, correlated: float,
) -> CellFits:  # fmt: skip
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
    correlated : [px²]
        Area over which points say as much as one, see `survey.export.correlated`.
    """
    order = np.argsort(cell, kind="stable")
    cell, offset, height = cell[order], offset[order], height[order].astype(np.float64)
    covered = _covered(cell, offset)
    enough = covered >= _LEAST_COVERED
    cell, offset, height, covered, order = (each[enough] for each in (cell, offset, height, covered, order))
    variance = np.square(std[order].astype(np.float64))
    numbers, start, count = np.unique(cell, return_index=True, return_counts=True)
    row = np.repeat(np.arange(len(numbers)), count)
    base = _medians(height, row, start, count)
    height = height - base[row]
    share = _independent(count, side, pixel, correlated)[row] / count[row]
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
    # A plane that rises by d across a cell has a variance of d^2 / 12 in it.
    uneven = relief + (plane[:, 1:] ** 2).sum(axis=1) / 12.0
    bare = np.square(1.0 - covered[start]) * uneven
    return CellFits(numbers, base + plane[:, 0], np.sqrt(plane_variance + bare), count)


def _covered(cell: np.ndarray, offset: np.ndarray) -> np.ndarray:
    """Share (N,) of the cell of each point that has points, by squares that hold four of them if they lie evenly."""
    numbers, row, count = np.unique(cell, return_inverse=True, return_counts=True)
    squares = np.clip(np.floor(0.5 * np.sqrt(count)), 1, _MOST_SQUARES).astype(np.int64)
    place = np.minimum(np.floor((offset + 0.5) * squares[row, None]).astype(np.int64), squares[row, None] - 1)
    taken = np.unique(row * _MOST_SQUARES**2 + place[:, 1] * _MOST_SQUARES + place[:, 0])
    held = np.bincount(taken // _MOST_SQUARES**2, minlength=len(numbers))
    return (held / squares**2)[row]


def _independent(count: np.ndarray, side: float, pixel: float, correlated: float) -> np.ndarray:
    """As how many independent points those of a cell count: by the area that they cover, at most that of the cell."""
    covered = np.minimum((side / pixel) ** 2, count.astype(np.float64))
    return np.minimum(1.0 + covered / correlated, count)


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
