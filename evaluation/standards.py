"""What two standards say about vertical errors: IHO S-44 and the ASPRS positional accuracy standards.

Only what was tested is judged; both standards ask for more than vertical accuracy.
"""

from __future__ import annotations

import math

import numpy as np

from evaluation.strata import DEPTH_EDGES_M

# IHO S-44 Ed. 6.1.0 (2022), table 1: total vertical uncertainty at 95 %, sqrt(a^2 + (b depth)^2), a in metres.
TVU = (
    ("Exclusive", 0.15, 0.0075),
    ("Special", 0.25, 0.0075),
    ("1a and 1b", 0.5, 0.013),
    ("2", 1.0, 0.023),
)
_TVU_SHARE = 0.95
_TVU_NOTE = (
    "Vertical uncertainty only: an order of IHO S-44 (Ed. 6.1.0) also asks for horizontal uncertainty, coverage and "
    "feature detection, which are not judged here."
)
# ASPRS, Edition 2 (2023, version 2 of 2024): fewer check points than this are not a test.
MIN_CHECKPOINTS = 30


def iho_s44(errors: np.ndarray, depth_m: np.ndarray) -> dict | None:
    """Which orders' total vertical uncertainty the points under water meet.

    Parameters
    ----------
    errors : (N,) [m]
        Vertical, of either sign; NaN is left out.
    depth_m : (N,) [m]
        Of the bed, positive below the water; other points are left out.

    Returns
    -------
    dict or None
        None if no point is left. ``points``, ``error_95_m`` (below which 95 % of the errors are), ``note`` and
        ``orders``, each with ``order``, ``tvu_at_median_depth_m``, ``share_within`` (share of the points whose error
        is at most the uncertainty at their own depth), ``meets_tvu`` (whether those are 95 %), and
        ``depth_bands`` with ``from_m``, ``to_m``, ``n_points`` and ``share_within``.
    """
    use = np.isfinite(errors) & (depth_m > 0.0)
    if not use.any():
        return None
    size, depth = np.abs(errors[use]), depth_m[use].astype(np.float64)
    return {
        "points": len(size),
        "error_95_m": float(np.quantile(size, _TVU_SHARE)),
        "orders": [_order(*row, size, depth) for row in TVU],
        "note": _TVU_NOTE,
    }


def _order(name: str, a: float, b: float, size: np.ndarray, depth: np.ndarray) -> dict:
    within = size <= np.hypot(a, b * depth)
    band = np.searchsorted(DEPTH_EDGES_M, depth, side="right") - 1
    bands = []
    for i in np.unique(band):
        part, top = within[band == i], DEPTH_EDGES_M[i + 1]
        limits = {"from_m": DEPTH_EDGES_M[i], "to_m": None if math.isinf(top) else top}
        bands.append(limits | {"n_points": len(part), "share_within": float(part.mean())})
    share = float(within.mean())
    return {
        "order": name,
        "tvu_at_median_depth_m": float(np.hypot(a, b * np.median(depth))),
        "share_within": share,
        "meets_tvu": share >= _TVU_SHARE,
        "depth_bands": bands,
    }


def asprs_vertical(residuals: np.ndarray, sigma_m: np.ndarray) -> dict:
    """Vertical accuracy by check points.

    Parameters
    ----------
    residuals : (K,) [m]
        Height of the product minus height of each check point; NaN where the product does not cover it.
    sigma_m : (K,) [m]
        Standard deviation of each check point's own height.

    Returns
    -------
    dict
        ``n_checkpoints``, ``n_not_covered``, ``mean_m``, ``std_m`` (of a sample), ``min_m``, ``max_m``; ``rmse_fit_m``
        of the residuals, ``rmse_checkpoints_m`` of the check points, and ``rmse_v_m``, the root of the sum of their
        squares; ``is_enough`` (30 or more). All but the counts are NaN where nothing is covered.

    Notes
    -----
    ASPRS Positional Accuracy Standards for Digital Geospatial Data, Edition 2: the survey error of the check points is
    part of the accuracy of the product, which is stated as a root mean square and no longer at 95 %.
    """
    covered = np.isfinite(residuals)
    r, sigma = residuals[covered], sigma_m[covered]
    counts = {"n_checkpoints": len(r), "n_not_covered": int((~covered).sum()), "is_enough": len(r) >= MIN_CHECKPOINTS}
    names = ("mean_m", "std_m", "min_m", "max_m", "rmse_fit_m", "rmse_checkpoints_m", "rmse_v_m")
    if not len(r):
        return counts | dict.fromkeys(names, math.nan)
    fit, own = math.sqrt(np.square(r).mean()), math.sqrt(np.square(sigma).mean())
    std = float(r.std(ddof=1)) if len(r) > 1 else math.nan
    values = (float(r.mean()), std, float(r.min()), float(r.max()), fit, own, math.hypot(fit, own))
    return counts | dict(zip(names, values, strict=True))
