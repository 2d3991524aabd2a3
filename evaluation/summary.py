"""Summary statistics of signed distances, of a whole cloud and by depth, incidence, views and slope."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from evaluation.bootstrap import Blocks, mean_interval
from evaluation.c2m import f_score

DEPTH_EDGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, math.inf)
INCIDENCE_EDGES_DEG = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0, 60.0, 90.0)
VIEWS_EDGES = (1, 2, 3, 4, 6, 8, 12, 16, 24, math.inf)
# Slopes of the reference. The last band holds its walls, where |n_z| of the normal is below 0.4.
SLOPE_EDGES_DEG = (0.0, 20.0, 45.0, 66.4, math.inf)
SHORELINE_MARGIN_M = 0.05


@dataclass(frozen=True)
class DistanceStatistics:
    """Counts and moments of distances; all but the counts are NaN where there is no distance."""

    n_points: int  # Finite distances
    n_nan: int  # Others, which are left out
    # [m]: the standard deviation is that of a population
    mean_m: float = math.nan
    median_m: float = math.nan
    std_m: float = math.nan
    rms_m: float = math.nan
    # [m]: of the distances d whose |d| is at most the 0.9 quantile of |d| (linear between points)
    mean_inner90_m: float = math.nan
    std_inner90_m: float = math.nan
    nmad_m: float = math.nan  # [m]: 1.4826 times the median absolute deviation from the median
    p95_abs_m: float = math.nan  # [m]: 0.95 quantile of |d|
    min_m: float = math.nan
    max_m: float = math.nan
    # (low, high) [m]: 95 % confidence intervals of the two means; None where no blocks were given
    mean_ci95_m: tuple[float, float] | None = None
    mean_inner90_ci95_m: tuple[float, float] | None = None


@dataclass(frozen=True)
class Scores:
    """Accuracy and completeness at one tolerance; shares are NaN where there is nothing to count."""

    completeness: float  # [-]: share of the samples of the reference that are closer than the tolerance to the cloud
    accuracy_share: float  # [-]: share of the points of the cloud that are closer than the tolerance to the reference
    f_score: float  # [-]: Harmonic mean of both
    tolerance_m: float  # [m]
    # [-] or None: as `completeness`, of the points of the reference that cameras see; None where those are not known
    completeness_visible: float | None = None


def scores(
    distances: np.ndarray, *, tolerance_m: float, is_reached: np.ndarray, is_reached_visible: np.ndarray | None = None
) -> Scores:
    """Accuracy and completeness at one tolerance, of distances (N,) [m], without NaN.

    ``is_reached`` (M,) bool says which samples of the reference lie closer than the tolerance to the cloud,
    ``is_reached_visible`` (K,) the same of points of the reference that cameras see.
    """
    finite = distances[np.isfinite(distances)]
    accuracy_share, completeness = _mean(np.abs(finite) < tolerance_m), _mean(is_reached)
    return Scores(
        completeness,
        accuracy_share,
        f_score(accuracy_share, completeness),
        float(tolerance_m),
        None if is_reached_visible is None else _mean(is_reached_visible),
    )


def distance_statistics(distances: np.ndarray, blocks: Blocks | None = None) -> DistanceStatistics:
    """Counts and moments of distances (N,) [m]; with blocks (`evaluation.spatial_blocks`) the means have intervals.

    Examples
    --------
    >>> found = distance_statistics(np.array([-0.1, 0.1, 0.3, np.nan]))
    >>> found.n_points, found.n_nan, round(found.mean_m, 3), found.median_m
    (3, 1, 0.1, 0.1)
    """
    finite = np.isfinite(distances)
    d = distances[finite].astype(np.float64, copy=False)
    counts = {"n_points": len(d), "n_nan": len(distances) - len(d)}
    if not len(d):
        unknown = None if blocks is None else (math.nan, math.nan)
        return DistanceStatistics(**counts, mean_ci95_m=unknown, mean_inner90_ci95_m=unknown)
    size = np.abs(d)
    q90, q95 = np.quantile(size, [0.9, 0.95])
    is_inner = size <= q90
    inner = d[is_inner]
    median = np.median(d)
    held = None if blocks is None else blocks.among(finite)
    return DistanceStatistics(
        **counts,
        mean_m=float(d.mean()),
        median_m=float(median),
        std_m=float(d.std()),
        rms_m=float(np.sqrt(np.square(d).mean())),
        mean_inner90_m=float(inner.mean()),
        std_inner90_m=float(inner.std()),
        nmad_m=float(std_by_median(d - median)),
        p95_abs_m=float(q95),
        min_m=float(d.min()),
        max_m=float(d.max()),
        mean_ci95_m=None if held is None else mean_interval(d, held),
        mean_inner90_ci95_m=None if held is None else mean_interval(inner, held.among(is_inner)),
    )


def _mean(is_true: np.ndarray) -> float:
    return float(np.mean(is_true)) if len(is_true) else math.nan


@dataclass(frozen=True)
class Band:
    """Points whose depth, incidence or number of views lies between two limits, in the unit of those."""

    low: float  # Belongs to the band
    high: float  # May be infinite
    distances: DistanceStatistics  # Of its points


@dataclass(frozen=True)
class ReachedBand:
    """Completeness where the slope of the reference lies between two limits [deg]."""

    low: float  # [deg]: belongs to the band
    high: float  # [deg]: may be infinite
    n_samples: int  # Of the reference, in the band
    completeness: tuple[float, ...]  # [-]: share of them that is reached, at each tolerance


@dataclass(frozen=True)
class DepthParts:
    """A cloud split at the water."""

    wet: DistanceStatistics | None  # Of the points more than 5 cm below the water; None without any
    dry: DistanceStatistics | None  # Of those as far above it
    bands: tuple[Band, ...]  # Of the wet points, by depth [m]; empty bands are left out


def by_depth(distances: np.ndarray, depth_m: np.ndarray, blocks: Blocks | None = None) -> DepthParts:
    """Statistics of distances (N,) [m] of the wet and the dry part, and of bands of depth.

    ``depth_m`` (N,) [m] is that of the bed, positive below the water; points with NaN are in no part.
    """
    wet, dry = (
        _statistics(distances, part, blocks) if part.any() else None
        for part in (depth_m > SHORELINE_MARGIN_M, depth_m < -SHORELINE_MARGIN_M)
    )
    return DepthParts(wet, dry, by_band(distances, depth_m, DEPTH_EDGES_M, blocks))


def by_band(
    distances: np.ndarray, values: np.ndarray, edges: tuple[float, ...], blocks: Blocks | None = None
) -> tuple[Band, ...]:
    """Statistics of distances (N,) [m] in bands of values (N,) between ascending edges; empty bands are left out."""
    return tuple(Band(low, high, _statistics(distances, part, blocks)) for low, high, part in _parts(values, edges))


def reached_by_slope(slope_deg: np.ndarray, is_reached: Sequence[np.ndarray]) -> tuple[ReachedBand, ...]:
    """Completeness in bands of the slope (M,) [deg] of the reference at its samples; empty bands are left out.

    ``is_reached`` holds for each tolerance which of the samples (M,) are reached.
    """
    return tuple(
        ReachedBand(low, high, int(part.sum()), tuple(float(np.mean(reached[part])) for reached in is_reached))
        for low, high, part in _parts(slope_deg, SLOPE_EDGES_DEG)
    )


def _parts(values: np.ndarray, edges: tuple[float, ...]) -> Iterator[tuple[float, float, np.ndarray]]:
    """Limits of each band and which values (N,) lie in it, without the empty ones."""
    for low, high in pairwise(edges):
        part = (values >= low) & (values < high)
        if part.any():
            yield low, high, part


def _statistics(distances: np.ndarray, part: np.ndarray, blocks: Blocks | None) -> DistanceStatistics:
    return distance_statistics(distances[part], None if blocks is None else blocks.among(part))


# Standard deviation of a normal distribution over its median absolute deviation.
MAD_TO_STD = 1.4826
# Huber's bound [standard deviations]: 95 % of good residuals lie within (P. J. Huber, Annals of Mathematical Statistics
# 35(1), 1964).
HUBER = 2.0
# The same for a few numbers of many observations, of which a tenth may be wrong: an efficiency of 95 % where errors are
# normal, and half the error that a bound of 2.0 leaves of such outliers.
HUBER_OF_MANY = 1.345


def std_by_median(residuals: np.ndarray, axis: int | None = None):
    """Standard deviation of residuals about zero, from the median of their absolute values."""
    return MAD_TO_STD * np.median(np.abs(residuals), axis=axis)


def huber_weights(length: np.ndarray, std: np.ndarray | float = 1.0, bound: float = HUBER) -> np.ndarray:
    """Huber's weights [-] of residuals of a length and a standard deviation: 1 within the bound, falling beyond."""
    return np.minimum(1.0, bound * std / np.maximum(length, 1e-300))
