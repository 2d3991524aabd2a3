"""Heights of cells from the points in them: a least-squares plane in each, with the standard deviation of its mean.

Each point has a standard deviation s. Where points scatter about the plane of their cell by more than that, the excess
is taken as relief of variance t², and the weight of a point is 1 / (s² + t²). So where a wall cuts the cell all points
weigh alike, as the mean over the area requires, and elsewhere uncertain points weigh little. Outliers are downweighted
(P. Huber 1964). A weak prior on the slope gives a height, with a realistic standard deviation, to cells whose points
lie on one side. Relief makes a mean uncertain only where points do not sample it. The uncovered part of a cell may
depart from the plane by as much as the bed rises and scatters in the covered part; cells that points cover by less than
a third have no height.

Also estimates the area over which errors of neighbouring points are correlated, from the cloud itself. Least squares
over photographs smooth a smooth bed more than a rough one, so that this area differs from survey to survey. Points
whose heights differ by less than their standard deviations must have correlated errors: where differences between
points at some distance have the variance D, the correlation is at least 1 - D / (s1² + s2²), since relief can only add
to D.
"""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from evaluation.summary import MAD_TO_STD, huber_weights

# Prior standard deviation of a slope: 45 degrees.
_SLOPE_STD = 1.0
# For coverage a cell is divided into squares, at most this many along a side; those with points are covered.
_MOST_SQUARES = 4
_LEAST_COVERED = 1.0 / 3.0
# Iterations of the reweighted least squares.
_STEPS = 3
# Least correlation area [px²]: this many points are worth one independent point. On rough beds it is 5 to 12.
LEAST_PX2 = 15.0
# Sample windows of a cloud: number, radius [px], most and fewest points in each.
_WINDOWS, _RADIUS_PX, _MOST_POINTS, _FEWEST_POINTS = 60, 9.0, 300, 60
# Longest distance of points [px]: beyond, relief that remains in a window hides the correlation of errors.
_REACH_PX = 4
# Squared differences are clipped at this many times their variance.
_LARGEST = 9.0
_SEED = 0


@dataclass(frozen=True)
class CellFits:
    """Planes of M cells, those that points cover well enough, in the order of their numbers."""

    cell: np.ndarray  # (M,) int64
    # height, std (M,) float64 [m]: mean of the plane over the cell, which is its height in the middle, and its standard
    # deviation
    height: np.ndarray
    std: np.ndarray
    count: np.ndarray  # (M,) int64: points


@dataclass(frozen=True)
class CellPoints:
    """N points in cells."""

    cell: np.ndarray  # (N,) int64: number of the cell of each point
    offset: np.ndarray  # (N, 2): east and north of each point from the middle of its cell, in sides: -0.5 to 0.5
    # height, std: (N,) [m]
    height: np.ndarray
    std: np.ndarray


def fit_cells(points: CellPoints, *, side: float, pixel: float, correlated: float) -> CellFits:
    """Fit a plane to the points of each cell of a side [m], for a pixel [m] and a correlation area [px²]."""
    order = np.argsort(points.cell, kind="stable")
    covered = _covered(points.cell[order], points.offset[order])
    enough = covered >= _LEAST_COVERED
    covered, order = covered[enough], order[enough]
    cell, offset, height = points.cell[order], points.offset[order], points.height[order].astype(np.float64)
    variance = np.square(points.std[order].astype(np.float64))
    numbers, start, count = np.unique(cell, return_index=True, return_counts=True)
    row = np.repeat(np.arange(len(numbers)), count)
    base = _medians(height, row, start, count)
    height = height - base[row]
    # Independent points in a cell: by the area that they cover, at most that of the cell.
    area_px2 = np.minimum((side / pixel) ** 2, count.astype(np.float64))
    share = np.minimum(1.0 + area_px2 / correlated, count)[row] / count[row]
    unsampled = 1.0 - np.minimum(count * (pixel / side) ** 2, 1.0)
    relief, huber = np.zeros(len(numbers)), np.ones(len(height))
    for _ in range(_STEPS):
        weight = huber / (variance + relief[row])
        plane, _ = _planes(row, share * weight, offset, height, len(numbers), side)
        residual = height - plane[row, 0] - (plane[row, 1:] * offset).sum(axis=1)
        spread = MAD_TO_STD * _medians(np.abs(residual), row, start, count)
        relief = np.maximum(spread**2 - np.bincount(row, huber * variance) / np.bincount(row, huber), 0.0)
        normalised = np.abs(residual) / np.sqrt(variance + relief[row])
        huber = huber_weights(normalised)
    weight = huber / (variance + (unsampled * relief)[row])
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


def correlated_px2(plan: np.ndarray, height: np.ndarray, std: np.ndarray, pixel: float) -> float:
    """Correlation area [px²] of the errors of points, at least `LEAST_PX2`: points in it are worth one alone.

    Points have places in plan (N, 2), heights and std (N,) [m]; a pixel is what one covers on the ground [m].
    """
    rng = np.random.default_rng(_SEED)
    tree = cKDTree(plan)
    squared, count = np.zeros((2, _REACH_PX))
    for middle in plan[rng.choice(len(plan), min(_WINDOWS, len(plan)), replace=False)]:
        near = np.sort(tree.query_ball_point(middle, _RADIUS_PX * pixel))
        if len(near) < _FEWEST_POINTS:
            continue
        if len(near) > _MOST_POINTS:
            near = rng.choice(near, _MOST_POINTS, replace=False)
        x, y = ((plan[near] - middle) / pixel).T
        # Less a quadratic surface, which takes out the relief.
        design, heights = np.column_stack([np.ones_like(x), x, y, x * x, x * y, y * y]), height[near].astype(np.float64)
        residual = heights - design @ np.linalg.lstsq(design, heights, rcond=None)[0]
        i, j = np.triu_indices(len(near), 1)
        distance = np.hypot(x[i] - x[j], y[i] - y[j])
        close = distance < _REACH_PX
        i, j, ring = i[close], j[close], distance[close].astype(np.int64)
        variance = np.square(std[near].astype(np.float64))
        share = np.minimum((residual[i] - residual[j]) ** 2 / (variance[i] + variance[j]), _LARGEST)
        squared += np.bincount(ring, share, _REACH_PX)
        count += np.bincount(ring, minlength=_REACH_PX)
    alike = np.maximum(1.0 - squared / np.maximum(count, 1.0), 0.0) * (count > 0)
    rings = np.pi * np.diff(np.arange(_REACH_PX + 1) ** 2)
    return max(float(alike @ rings), LEAST_PX2)
