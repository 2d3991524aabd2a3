"""Signed distances as numbers for a report."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from evaluation.completeness import f_score

# The normal distribution has its median absolute deviation at 1 / 1.4826 standard deviations.
_STD_PER_MAD = 1.4826
DEPTH_EDGES_M = (0.0, 0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 15.0, 20.0, 30.0, math.inf)
SHORELINE_MARGIN_M = 0.05


def summarise(
    distances: np.ndarray,
    *,
    tolerance_m: float,
    is_reached: np.ndarray,
    is_reached_visible: np.ndarray | None = None,
    num_cropped: int = 0,
    depth_m: np.ndarray | None = None,
) -> dict:
    """All numbers of a comparison.

    Parameters
    ----------
    distances : (N,) [m]
        Signed (unsigned if the reference is a cloud). NaN is counted as ``n_nan`` and left out.
    tolerance_m : [m]
    is_reached : (M,) bool
        Which samples of the reference lie closer than the tolerance to the cloud.
    is_reached_visible : (K,) bool, optional
        The same for points of the reference that cameras see.
    num_cropped : int
        Points that were left out before.
    depth_m : (N,) [m], optional
        Depth of the bed at each point, positive below the water; NaN where it is not known.

    Returns
    -------
    dict
        ``n_points``, ``n_cropped`` and those of `distance_statistics`; ``completeness``, ``accuracy_share``
        (share with |d| below the tolerance), ``f_score``, ``tolerance_m``; with ``is_reached_visible`` also
        ``completeness_visible``; with depths, where any is known, also those of `by_depth`.
    """
    statistics = distance_statistics(distances)
    finite = distances[np.isfinite(distances)]
    accuracy_share = _mean(np.abs(finite) < tolerance_m)
    completeness = _mean(is_reached)
    numbers = {
        "n_points": statistics.pop("n_points"),
        "n_cropped": int(num_cropped),
        **statistics,
        "completeness": completeness,
        "accuracy_share": accuracy_share,
        "f_score": f_score(accuracy_share, completeness),
        "tolerance_m": float(tolerance_m),
    }
    if is_reached_visible is not None:
        numbers["completeness_visible"] = _mean(is_reached_visible)
    if depth_m is not None and np.isfinite(depth_m).any():
        numbers |= by_depth(distances, depth_m)
    return numbers


def distance_statistics(distances: np.ndarray) -> dict:
    """Counts and moments of distances (N,) [m].

    Returns
    -------
    dict
        ``n_points`` (finite ones), ``n_nan``; ``mean_m``, ``median_m``, ``std_m`` (population), ``rms_m``;
        ``mean_inner90_m`` and ``std_inner90_m`` over the points whose |d| is at most the 0.9 quantile of |d|
        (linear between points); ``nmad_m`` (1.4826 times the median absolute deviation from the median),
        ``p95_abs_m``, ``min_m``, ``max_m``. All but the counts are NaN if there is no point.
    """
    d = distances[np.isfinite(distances)].astype(np.float64, copy=False)
    counts = {"n_points": len(d), "n_nan": len(distances) - len(d)}
    if not len(d):
        names = (
            "mean",
            "median",
            "std",
            "rms",
            "mean_inner90",
            "std_inner90",
            "nmad",
            "p95_abs",
            "min",
            "max",
        )
        return counts | {f"{name}_m": math.nan for name in names}
    size = np.abs(d)
    q90, q95 = np.quantile(size, [0.9, 0.95])
    inner = d[size <= q90]
    median = np.median(d)
    values = {
        "mean_m": d.mean(),
        "median_m": median,
        "std_m": d.std(),
        "rms_m": np.sqrt(np.square(d).mean()),
        "mean_inner90_m": inner.mean(),
        "std_inner90_m": inner.std(),
        "nmad_m": _STD_PER_MAD * np.median(np.abs(d - median)),
        "p95_abs_m": q95,
        "min_m": d.min(),
        "max_m": d.max(),
    }
    return counts | {name: float(value) for name, value in values.items()}


def by_depth(distances: np.ndarray, depth_m: np.ndarray) -> dict:
    """Statistics of the wet and the dry part, and of bands of depth.

    Parameters
    ----------
    distances : (N,) [m]
    depth_m : (N,) [m]
        Of the bed, positive below the water; points with NaN are in no part.

    Returns
    -------
    dict
        ``wet`` and ``dry``: `distance_statistics` of the points more than 5 cm below and above the water,
        where the split is beyond doubt (left out if there is none). ``depth_bands``: a list of those of the
        wet points between ``from_m`` (included) and ``to_m``, empty bands left out; ``to_m`` of the last is
        None.
    """
    parts = {"wet": depth_m > SHORELINE_MARGIN_M, "dry": depth_m < -SHORELINE_MARGIN_M}
    split = {name: distance_statistics(distances[part]) for name, part in parts.items() if part.any()}
    bands = []
    for low, high in pairwise(DEPTH_EDGES_M):
        part = (depth_m >= low) & (depth_m < high)
        if part.any():
            to_m = None if math.isinf(high) else high
            bands.append({"from_m": low, "to_m": to_m, **distance_statistics(distances[part])})
    return {**split, "depth_bands": bands}


def _mean(is_true: np.ndarray) -> float:
    return float(np.mean(is_true)) if len(is_true) else math.nan
