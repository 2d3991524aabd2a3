"""Block bootstrap: confidence intervals of a mean whose errors are correlated in space.

Neighbouring points of a cloud share windows, views and poses, and so their errors: sigma / sqrt(n) of a million
points would be micrometres, far too small. Blocks some correlation lengths wide are nearly independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy import special

NUM_DRAWS = 1000
LEVEL = 0.95
SEED = 20_060_618  # any number, but always the same
# Fewer blocks than this do not show their spread.
MIN_BLOCKS = 10
# Under exponential correlation, blocks this many correlation lengths wide miss an eighth of the standard error, from
# pairs across their edges; that part is estimated from blocks half as wide.
_LENGTHS_PER_BLOCK = 10.0
# Blocks are narrowed until there are this many; more than this many would only cost time.
_FEWEST, _MOST = 30, 1024
_POINTS_PER_CELL, _MOST_CELLS = 4.0, 512
_CELLS_PER_BLOCK = 4.0
_STRAY_SHARE = 0.001
# Standard errors by which the first lag of the correlogram has to exceed zero to count as correlation.
_SIGNIFICANT = 3.0


def cell_numbers(at: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Cell (N,) int64, row by row, of points at a column and row (N, 2) [cells]; -1 beyond the raster and for NaN."""
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


@dataclass(frozen=True)
class Blocks:
    """Square blocks of the plan."""

    number: np.ndarray  # (N,) int64: the block of each point, from 0
    size_m: float  # [m]: edge of a block
    # [m]: lag at which the correlation of the errors has fallen to 1/e; 0 where neighbours are not correlated
    correlation_m: float
    widening: float  # Factor by which intervals are widened for correlation across the edges of blocks
    is_narrow: bool  # Whether the extent is too small for blocks of ten correlation lengths: intervals may be too short

    def among(self, part: np.ndarray) -> Blocks:
        """The blocks of some of the points, ``part`` a mask (N,) or rows."""
        return replace(self, number=self.number[part])


def spatial_blocks(plan: np.ndarray, errors: np.ndarray) -> Blocks:
    """Blocks whose edge is ten correlation lengths of the errors (N,) [m], if the extent has room for 30 of them.

    ``plan`` (N, 2) [m] are horizontal coordinates in a Cartesian frame; errors that are NaN are left out. The variance
    of the mean from blocks of an edge b is too small by about c / b. Twice that of b less that of b / 2 is not (D.
    Politis, J. Romano, Bias-corrected nonparametric spectral estimation, Journal of Time Series Analysis 16, 1995);
    intervals are widened by the root of the ratio.
    """
    known = np.isfinite(errors)
    plan = np.asarray(plan, dtype=np.float64)
    if not known.any():
        return Blocks(np.zeros(len(plan), dtype=np.int64), math.nan, math.nan, 1.0, True)
    grid = _Cells.over(plan[known])
    correlation = grid.correlation_length(plan[known], errors[known])
    required_size = max(_LENGTHS_PER_BLOCK * correlation, _CELLS_PER_BLOCK * grid.cell, math.sqrt(grid.area / _MOST))
    widest = math.sqrt(grid.area / _FEWEST)
    size = min(required_size, widest)
    number = grid.squares(plan, size)
    variance, variance_of_halves = (
        _variance_of_mean(errors[known], n[known]) for n in (number, grid.squares(plan, 0.5 * size))
    )
    widening = math.sqrt(max(2.0 - variance_of_halves / variance, 1.0)) if variance > 0.0 else 1.0
    return Blocks(number, size, correlation, widening, required_size > widest)


def mean_interval(values: np.ndarray, blocks: Blocks) -> tuple[float, float]:
    """Interval that holds the mean of values (N,) with 95 % confidence; NaN where fewer than ten blocks have any.

    The percentiles of the means of 1000 sets of blocks, each drawn with replacement from those that hold points
    (P. Hall, Resampling a coverage pattern, Stochastic Processes and their Applications 20, 1985, with fixed blocks),
    moved away from the mean by `Blocks.widening` and by the ratio of Student's quantile to the normal one.
    """
    known = np.isfinite(values)
    if not known.any():
        return math.nan, math.nan
    number = blocks.number[known]
    counts = np.bincount(number)
    held = np.flatnonzero(counts)
    if len(held) < MIN_BLOCKS:
        return math.nan, math.nan
    sums = np.bincount(number, weights=values[known])[held]
    counts = counts[held].astype(np.float64)
    drawn = np.random.default_rng(SEED).integers(len(held), size=(NUM_DRAWS, len(held)))
    means = sums[drawn].sum(axis=1) / counts[drawn].sum(axis=1)
    ends = np.quantile(means, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    student = special.stdtrit(len(held) - 1, 0.5 + 0.5 * LEVEL) / special.ndtri(0.5 + 0.5 * LEVEL)
    mean = sums.sum() / counts.sum()
    low, high = mean + blocks.widening * student * (ends - mean)
    return float(low), float(high)


def _variance_of_mean(values: np.ndarray, number: np.ndarray) -> float:
    """Variance of the mean of values (N,) if their blocks are independent."""
    sums, counts = np.bincount(number, weights=values - values.mean()), np.bincount(number)
    held = int(np.count_nonzero(counts))
    return float(np.square(sums).sum()) / len(values) ** 2 * held / max(held - 1, 1)


@dataclass(frozen=True)
class _Cells:
    """Cells of a few points each, from which the correlation of errors is estimated."""

    low: np.ndarray
    cell: float
    shape: tuple[int, int]
    area: float

    @staticmethod
    def over(plan: np.ndarray) -> _Cells:
        low = np.quantile(plan, _STRAY_SHARE, axis=0, method="lower")
        high = np.quantile(plan, 1.0 - _STRAY_SHARE, axis=0, method="higher")
        # Points on a line or on one spot still need a cell of some size.
        size = np.maximum(high - low, max(1e-3 * float((high - low).max()), 1e-6))
        cell = max(float(size.max()) / _MOST_CELLS, math.sqrt(_POINTS_PER_CELL * float(size.prod()) / len(plan)))
        columns, rows = (math.floor(side / cell) + 1 for side in size)
        shape = (rows, columns)
        occupied = np.count_nonzero(cell_counts(cell_numbers((plan - low) / cell, shape), shape))
        return _Cells(low, cell, shape, occupied * cell**2)

    def squares(self, plan: np.ndarray, size: float) -> np.ndarray:
        """Number (N,) of the square of edge ``size`` that holds each point; points outside go to the nearest one."""
        most = np.ceil(np.array(self.shape[::-1]) * self.cell / size)
        column, row = np.clip(np.floor((np.nan_to_num(plan) - self.low) / size), 0, most - 1).astype(np.int64).T
        return row * int(most[0]) + column

    def correlation_length(self, plan: np.ndarray, errors: np.ndarray) -> float:
        """Lag [m] at which the correlation between cells has fallen to 1/e.

        Noise of single points, which neighbours do not share, is not counted: the correlation at lag 0 is extrapolated
        from those at one and two cells. 0 where neighbours share nothing; at most half the shorter side.
        """
        mean = cell_means(cell_numbers((plan - self.low) / self.cell, self.shape), errors, self.shape)
        held = np.isfinite(mean)
        mean = np.where(held, mean - mean[held].mean(), 0.0)
        products, pairs = _autocorrelation(mean), _autocorrelation(held.astype(np.float64))
        lags = np.hypot(*np.meshgrid(*(np.fft.fftfreq(n, 1.0 / n) for n in products.shape), indexing="ij"))
        ring = np.rint(lags).astype(np.int64).ravel()
        longest = max(min(self.shape) // 2, 1)
        number = np.bincount(ring, weights=pairs.ravel())[: longest + 1]
        covariance = np.bincount(ring, weights=products.ravel())[: longest + 1] / np.maximum(number, 1.0)
        # Each pair of cells appears at a lag and at its opposite.
        if covariance[1] * math.sqrt(0.5 * number[1]) <= _SIGNIFICANT * covariance[0]:
            return 0.0
        at_lag_2 = covariance[min(2, longest)]
        shared = min(covariance[0], covariance[1] ** 2 / at_lag_2) if at_lag_2 > 0.0 else covariance[1]
        curve = np.concatenate([[shared], covariance[1:]])
        falls = np.flatnonzero(curve < shared / math.e)
        if not len(falls):
            return longest * self.cell
        above, below = curve[falls[0] - 1 : falls[0] + 1]
        return (falls[0] - 1 + (above - shared / math.e) / (above - below)) * self.cell


def _autocorrelation(image: np.ndarray) -> np.ndarray:
    """Sums of products of cells by lag, of an image padded against wrapping around."""
    shape = [2 * n for n in image.shape]
    return np.fft.irfft2(np.abs(np.fft.rfft2(image, shape)) ** 2, shape)
