"""Signed distances as numbers for a report."""

from __future__ import annotations

import math

import numpy as np

from evaluation.bootstrap import Blocks, mean_interval
from evaluation.completeness import f_score

# The normal distribution has its median absolute deviation at 1 / 1.4826 standard deviations.
_STD_PER_MAD = 1.4826


def summarise(
    distances: np.ndarray,
    *,
    tolerance_m: float,
    is_reached: np.ndarray,
    is_reached_visible: np.ndarray | None = None,
    num_cropped: int = 0,
    blocks: Blocks | None = None,
) -> dict:
    """The numbers of a comparison over all its points.

    Parameters
    ----------
    distances : (N,) [m]
        Signed (unsigned if the reference is a cloud). NaN is counted as ``n_nan`` and left out.
    tolerance_m, is_reached, is_reached_visible :
        As `scores`.
    num_cropped : int
        Points that were left out before.
    blocks : Blocks of the N points, optional
        As `distance_statistics`.

    Returns
    -------
    dict
        ``n_points``, ``n_cropped`` and those of `distance_statistics` and `scores`.
    """
    statistics = distance_statistics(distances, blocks)
    return {
        "n_points": statistics.pop("n_points"),
        "n_cropped": int(num_cropped),
        **statistics,
        **scores(distances, tolerance_m=tolerance_m, is_reached=is_reached, is_reached_visible=is_reached_visible),
    }


def scores(
    distances: np.ndarray,
    *,
    tolerance_m: float,
    is_reached: np.ndarray,
    is_reached_visible: np.ndarray | None = None,
) -> dict:
    """Accuracy and completeness at one tolerance.

    Parameters
    ----------
    distances : (N,) [m]
        NaN is left out.
    tolerance_m : [m]
    is_reached : (M,) bool
        Which samples of the reference lie closer than the tolerance to the cloud.
    is_reached_visible : (K,) bool, optional
        The same for points of the reference that cameras see.

    Returns
    -------
    dict
        ``completeness``, ``accuracy_share`` (share with |d| below the tolerance), ``f_score``, ``tolerance_m``;
        with ``is_reached_visible`` also ``completeness_visible``.
    """
    finite = distances[np.isfinite(distances)]
    accuracy_share, completeness = _mean(np.abs(finite) < tolerance_m), _mean(is_reached)
    numbers = {
        "completeness": completeness,
        "accuracy_share": accuracy_share,
        "f_score": f_score(accuracy_share, completeness),
        "tolerance_m": float(tolerance_m),
    }
    if is_reached_visible is not None:
        numbers["completeness_visible"] = _mean(is_reached_visible)
    return numbers


def distance_statistics(distances: np.ndarray, blocks: Blocks | None = None) -> dict:
    """Counts and moments of distances (N,) [m].

    Parameters
    ----------
    distances : (N,) [m]
    blocks : Blocks of the N points, optional
        From `evaluation.spatial_blocks`; with them each mean gets an interval of 95 % confidence.

    Returns
    -------
    dict
        ``n_points`` (finite ones), ``n_nan``; ``mean_m``, ``median_m``, ``std_m`` (population), ``rms_m``;
        ``mean_inner90_m`` and ``std_inner90_m`` over the points whose |d| is at most the 0.9 quantile of |d|
        (linear between points); ``nmad_m`` (1.4826 times the median absolute deviation from the median),
        ``p95_abs_m``, ``min_m``, ``max_m``; with blocks ``mean_ci95_m`` and ``mean_inner90_ci95_m``, each
        [low, high]. All but the counts are NaN if there is no point.
    """
    finite = np.isfinite(distances)
    d = distances[finite].astype(np.float64, copy=False)
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
        values = {f"{name}_m": math.nan for name in names}
        intervals = ("mean_ci95_m", "mean_inner90_ci95_m") if blocks is not None else ()
        return counts | values | {name: [math.nan, math.nan] for name in intervals}
    size = np.abs(d)
    q90, q95 = np.quantile(size, [0.9, 0.95])
    is_inner = size <= q90
    inner = d[is_inner]
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
    numbers = counts | {name: float(value) for name, value in values.items()}
    if blocks is not None:
        held = blocks.among(finite)
        numbers["mean_ci95_m"] = list(mean_interval(d, held))
        numbers["mean_inner90_ci95_m"] = list(mean_interval(inner, held.among(is_inner)))
    return numbers


def _mean(is_true: np.ndarray) -> float:
    return float(np.mean(is_true)) if len(is_true) else math.nan
