"""Volumes of a grid of differences, and their standard deviations in closed form.

A difference d of a cell has an error of its own (std s), alike in cells close by, and one that all cells of a survey
share (std c of each survey, fully correlated over it). With the correlation r(h) of own errors at a distance h, the
variance of a sum of cells of area a is

    a² (sum over h of r(h) W(h))  +  a² (A² + B² - 2 q A B),    W(h) = sum over cells of s(x) s(x + h),

A and B the sums of c over the cells of each survey, q the correlation of what the two surveys share. W is computed
exactly by FFT, edges and gaps included. r is exponential (a variogram with a nugget): its share and length are measured
in the differences of cells that have not changed.

Source of the level of detection: J. Wheaton et al., Accounting for uncertainty in DEMs from repeat topographic surveys
(2010); of correlated errors in volumes: S. Rolstad et al., Spatially integrated geodetic glacier mass balance (2009).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft2, next_fast_len, rfft2

# Of a normal deviate: two-sided, 95 %.
Z95 = 1.959964
MAD_TO_STD = 1.4826
# Differences beyond so many robust standard deviations have changed.
CHANGED = 3.0
# Lags are looked at up to this share of the shorter side: of longer ones there are few independent pairs.
_LONGEST_LAG = 0.25
_FEWEST_CELLS = 100
_NUM_LENGTHS = 60


@dataclass(frozen=True)
class Correlation:
    """Correlation of own errors: 1 at no distance, ``share * exp(-distance / length_m)`` beyond."""

    share: float  # 0 to 1
    length_m: float  # [m]
    # Standard deviation of unchanged differences over the one stated; None where it was not measured
    scatter: float | None = None

    def at(self, distance_m: np.ndarray) -> np.ndarray:
        """The correlation at distances [m]."""
        return np.where(distance_m > 0.0, self.share * np.exp(-distance_m / max(self.length_m, 1e-9)), 1.0)


@dataclass(frozen=True)
class Differences:
    """Second height minus first, in cells; arrays (rows, columns), NaN where one of the surveys has no height."""

    height: np.ndarray  # [m]
    std: np.ndarray  # [m]: by the own errors of both
    # (2, rows, columns) [m]: standard deviation of what all cells of the first and of the second survey share
    common: np.ndarray
    # -1 to 1: correlation of these two: 0 for surveys with a level and poses of their own, 1 where all of it is the
    # same
    shared: float
    side_m: float  # [m]

    @property
    def is_known(self) -> np.ndarray:
        """Cells (rows, columns) with a difference and its standard deviation."""
        return np.isfinite(self.height) & np.isfinite(self.std) & np.isfinite(self.common).all(axis=0)

    @property
    def detection(self) -> np.ndarray:
        """Minimum level of detection (rows, columns) [m] at 95 %: smaller differences are not significant."""
        first, second = self.common
        variance = self.std**2 + first**2 + second**2 - 2.0 * self.shared * first * second
        return Z95 * np.sqrt(np.maximum(variance, 0.0))

    @property
    def is_significant(self) -> np.ndarray:
        """Cells (rows, columns) beyond the level of detection."""
        return self.is_known & (np.abs(self.height) > self.detection)


@dataclass(frozen=True)
class Volume:
    """A volume [m³] with its standard deviation, over an area [m²]."""

    volume_m3: float
    std_m3: float
    area_m2: float

    @property
    def interval95_m3(self) -> tuple[float, float]:
        """The interval that holds the true volume with a probability of 95 %."""
        half = Z95 * self.std_m3
        return self.volume_m3 - half, self.volume_m3 + half


def volume_of(differences: Differences, cells: np.ndarray, correlation: Correlation) -> Volume:
    """The volume of the differences of some cells (rows, columns) bool, all of which are known."""
    area = differences.side_m**2
    own = np.where(cells, np.nan_to_num(differences.std), 0.0)
    first, second = (float(np.where(cells, np.nan_to_num(c), 0.0).sum()) for c in differences.common)
    variance = _correlated_sum(own, differences.side_m, correlation)
    variance += first**2 + second**2 - 2.0 * differences.shared * first * second
    total = float(np.where(cells, np.nan_to_num(differences.height), 0.0).sum())
    return Volume(area * total, area * math.sqrt(max(variance, 0.0)), area * int(cells.sum()))


def measured_correlation(differences: Differences, cells: np.ndarray) -> Correlation:
    """The correlation of own errors, by differences over their standard deviations in cells that have not changed.

    The exponential function is fitted by least squares to the correlations at all lags, each with the weight of its
    number of pairs.

    Raises
    ------
    ValueError
        If there are fewer than a hundred of them, or they do not scatter.
    """
    ratio = np.where(cells, differences.height / differences.std, np.nan)
    middle = np.nanmedian(ratio)
    spread = MAD_TO_STD * float(np.nanmedian(np.abs(ratio - middle)))
    same = np.isfinite(ratio) & (np.abs(ratio - middle) <= CHANGED * max(spread, 1e-12))
    if same.sum() < _FEWEST_CELLS:
        raise ValueError(f"{int(same.sum())} cells have not changed, expected at least {_FEWEST_CELLS}")
    if np.ptp(ratio[same]) == 0.0:
        raise ValueError("differences do not scatter: both surveys have the same heights")
    rest = np.where(same, ratio - ratio[same].mean(), 0.0)
    pairs, distance = _autocorrelation(same.astype(np.float64), differences.side_m)
    products, _ = _autocorrelation(rest, differences.side_m)
    longest = _LONGEST_LAG * min(differences.height.shape) * differences.side_m
    used = (distance > 0.0) & (distance <= max(longest, 2.0 * differences.side_m)) & (pairs > 0.5)
    value = products[used] / pairs[used] / (products.flat[0] / pairs.flat[0])
    weight, lag = pairs[used], distance[used]
    best = (math.inf, 0.0, differences.side_m)
    for length in np.geomspace(0.3 * differences.side_m, max(longest, differences.side_m), _NUM_LENGTHS):
        shape = np.exp(-lag / length)
        share = float(np.clip((weight * value * shape).sum() / (weight * shape**2).sum(), 0.0, 1.0))
        best = min(best, (float((weight * (value - share * shape) ** 2).sum()), share, float(length)))
    return Correlation(best[1], best[2], spread)


def _correlated_sum(own: np.ndarray, side_m: float, correlation: Correlation) -> float:
    """Variance of the sum of errors with standard deviations (rows, columns), 0 where there is none."""
    products, distance = _autocorrelation(own, side_m)
    return float((products * correlation.at(distance)).sum())


def _autocorrelation(values: np.ndarray, side_m: float) -> tuple[np.ndarray, np.ndarray]:
    """Sums of products at all lags, and the lengths [m] of these."""
    shape = tuple(next_fast_len(2 * n - 1, real=True) for n in values.shape)
    spectrum = rfft2(values, shape)
    sums = irfft2(np.abs(spectrum) ** 2, shape)
    rows, columns = (np.minimum(np.arange(n), n - np.arange(n)) for n in shape)
    return sums, side_m * np.hypot(rows[:, None], columns[None, :])
