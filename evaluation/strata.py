"""Bias and spread of the parts of a cloud, by depth, incidence, views and slope; completeness by slope."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from evaluation.bootstrap import Blocks
from evaluation.summary import DistanceStatistics, distance_statistics

DEPTH_EDGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, math.inf)
INCIDENCE_EDGES_DEG = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 35.0, 40.0, 50.0, 60.0, 90.0)
VIEWS_EDGES = (1, 2, 3, 4, 6, 8, 12, 16, 24, math.inf)
# Of the reference. The last band are its walls: |n_z| of their normals is below 0.4.
SLOPE_EDGES_DEG = (0.0, 20.0, 45.0, 66.4, math.inf)
SHORELINE_MARGIN_M = 0.05


@dataclass(frozen=True)
class Band:
    """Points whose depth, incidence or number of views lies between two limits, in the unit of those."""

    # low, high: The lower limit belongs to the band; the upper one may be infinite
    low: float
    high: float
    distances: DistanceStatistics  # Of its points


@dataclass(frozen=True)
class ReachedBand:
    """Completeness where the slope of the reference lies between two limits [deg]."""

    # low, high [deg]: the lower limit belongs to the band; the upper one may be infinite
    low: float
    high: float
    n_samples: int  # Of the reference, in the band
    completeness: tuple[float, ...]  # [-]: share of them that is reached, at each tolerance


@dataclass(frozen=True)
class DepthParts:
    """A cloud split at the water."""

    # wet, dry: Of the points more than 5 cm below and above the water; None without any
    wet: DistanceStatistics | None
    dry: DistanceStatistics | None
    bands: tuple[Band, ...]  # Of the wet points, by depth [m]; empty bands are left out


def by_depth(distances: np.ndarray, depth_m: np.ndarray, blocks: Blocks | None = None) -> DepthParts:
    """Statistics of the wet and the dry part, and of bands of depth.

    Parameters
    ----------
    distances : (N,) [m]
    depth_m : (N,) [m]
        Of the bed, positive below the water; points with NaN are in no part.
    blocks : Blocks of the N points, optional
        As `distance_statistics`.
    """
    wet, dry = (
        _statistics(distances, part, blocks) if part.any() else None
        for part in (depth_m > SHORELINE_MARGIN_M, depth_m < -SHORELINE_MARGIN_M)
    )
    return DepthParts(wet, dry, by_band(distances, depth_m, DEPTH_EDGES_M, blocks))


def by_band(
    distances: np.ndarray, values: np.ndarray, edges: tuple[float, ...], blocks: Blocks | None = None
) -> tuple[Band, ...]:
    """Statistics of distances in bands of another value; bands without a point are left out.

    Parameters
    ----------
    distances : (N,) [m]
    values : (N,)
        Points with NaN are in no band.
    edges : ascending
    blocks : Blocks of the N points, optional
        As `distance_statistics`.
    """
    return tuple(Band(low, high, _statistics(distances, part, blocks)) for low, high, part in _parts(values, edges))


def reached_by_slope(slope_deg: np.ndarray, is_reached: Sequence[np.ndarray]) -> tuple[ReachedBand, ...]:
    """Completeness in bands of slope; bands without a sample are left out.

    Parameters
    ----------
    slope_deg : (M,) [deg]
        Of the reference at its samples.
    is_reached : sequence of (M,) bool
        Which of them are reached, at each tolerance.
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
