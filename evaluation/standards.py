"""Vertical accuracy by two standards: IHO S-44 and the ASPRS positional accuracy standards.

Only what was tested is judged; both standards ask for more than vertical accuracy.
"""

import math
from dataclasses import dataclass

import numpy as np

from evaluation.summary import DEPTH_EDGES_M

# IHO S-44 Ed. 6.1.0 (2022), table 1: total vertical uncertainty at 95 %, sqrt(a^2 + (b depth)^2), a in metres.
TVU = (("Exclusive", 0.15, 0.0075), ("Special", 0.25, 0.0075), ("1a and 1b", 0.5, 0.013), ("2", 1.0, 0.023))
# Total horizontal uncertainty at 95 %, a + b depth, a in metres.
THU = (("Exclusive", 1.0, 0.0), ("Special", 2.0, 0.0), ("1a and 1b", 5.0, 0.05), ("2", 20.0, 0.1))
# A band of depth with fewer points is not judged: the share of so many independent points within the limit scatters by
# 0.7 %, and by more where neighbouring points share errors.
MIN_BAND_POINTS = 1000
# Factors from a standard deviation to 95 %, for a normal error in one and in two equal dimensions.
TO_95, TO_95_IN_PLAN = 1.959964, 2.447747
_TVU_SHARE = 0.95
# ASPRS, Edition 2 (2023, version 2 of 2024): fewer check points than this are not a test.
MIN_CHECKPOINTS = 30


@dataclass(frozen=True)
class TvuBand:
    """Points in a band of depth."""

    low_m: float  # [m]: belongs to the band
    high_m: float  # [m]: may be infinite
    n_points: int
    share_within: float  # [-]: of them, with an error of at most the uncertainty that the order allows at their depth
    share_possible: float  # [-]: the same with the uncertainty of the reference added to what is allowed; not smaller


@dataclass(frozen=True)
class TvuOrder:
    """Fulfilment of one order of IHO S-44."""

    name: str
    tvu_at_median_depth_m: float  # [m]: total vertical uncertainty that the order allows there
    share_within: float  # [-]: share of the points whose error is at most the uncertainty at their own depth
    share_possible: float  # [-]: the same with the uncertainty of the reference added to what is allowed; not smaller
    bands: tuple[TvuBand, ...]

    @property
    def meets_tvu(self) -> bool:
        """Whether at least 95 % of all points, whatever their depth, are within the limit."""
        return self.share_within >= _TVU_SHARE

    @property
    def is_undecided(self) -> bool:
        """Whether fewer are within, but the error of the reference may be the cause."""
        return self.share_within < _TVU_SHARE <= self.share_possible

    @property
    def failing(self) -> tuple[TvuBand, ...]:
        """Bands of `MIN_BAND_POINTS` with less than 95 % within, whatever the error of the reference."""
        return tuple(b for b in self.bands if b.n_points >= MIN_BAND_POINTS and b.share_possible < _TVU_SHARE)

    @property
    def undecided(self) -> tuple[TvuBand, ...]:
        """Such bands where the error of the reference may be the cause."""
        large = (b for b in self.bands if b.n_points >= MIN_BAND_POINTS)
        return tuple(b for b in large if b.share_within < _TVU_SHARE <= b.share_possible)

    @property
    def meets_tvu_at_all_depths(self) -> bool:
        """Whether 95 % are within, of all points and in each of those bands."""
        return self.meets_tvu and not self.failing and not self.undecided


@dataclass(frozen=True)
class IhoS44:
    """Orders of IHO S-44 whose total vertical uncertainty a cloud meets."""

    n_points: int  # Points under water with a known error
    error_95_m: float  # [m]: 95 % of the errors are smaller
    orders: tuple[TvuOrder, ...]  # The strictest first
    # What is not judged
    note: str = (
        "Vertical uncertainty only: an order of IHO S-44 (Ed. 6.1.0) also asks for horizontal uncertainty, coverage "
        "and feature detection, which are not judged here."
    )

    @property
    def strictest(self) -> TvuOrder | None:
        """The first whose uncertainty is met at all depths."""
        return next((order for order in self.orders if order.meets_tvu_at_all_depths), None)


@dataclass(frozen=True)
class AsprsAccuracy:
    """Vertical accuracy by check points; all but the counts are NaN where the product covers none."""

    n_checkpoints: int  # That the product covers
    n_not_covered: int
    is_enough: bool  # Whether they are 30 or more
    # [m]: of the residuals; the standard deviation is that of a sample
    mean_m: float = math.nan
    std_m: float = math.nan
    min_m: float = math.nan
    max_m: float = math.nan
    # [m]: root mean square of the residuals, of the check points' own errors, and the root of the sum of their squares
    rmse_fit_m: float = math.nan
    rmse_checkpoints_m: float = math.nan
    rmse_v_m: float = math.nan


def iho_s44(errors: np.ndarray, depth_m: np.ndarray, reference_std_m: np.ndarray | None = None) -> IhoS44 | None:
    """Orders of IHO S-44 whose total vertical uncertainty the points under water meet; None if there is no such point.

    Vertical errors (N,) [m] that are NaN, and depths (N,) [m] that are not positive, are left out. An order that is
    missed by no more than 1.96 of the standard deviation of the reference heights (N,) [m] is undecided; one that is
    met stays met, since errors of the reference only widen the differences.
    """
    use = np.isfinite(errors) & (depth_m > 0.0)
    if not use.any():
        return None
    size, depth = np.abs(errors[use]), depth_m[use].astype(np.float64)
    reference_error = np.zeros(len(size)) if reference_std_m is None else TO_95 * reference_std_m[use]
    orders = tuple(_order(*row, size, depth, reference_error) for row in TVU)
    return IhoS44(len(size), float(np.quantile(size, _TVU_SHARE)), orders)


def order_by_tvu(std_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Strictest order (...) of `TVU` that heights of standard deviations (...) [m] meet at depths (...) [m].

    uint8: 1 for the first of the table, 5 for none, 0 where a value is NaN or the depth is not positive.
    """
    return _strictest([TO_95 * std_m <= np.hypot(a, b * depth_m) for _, a, b in TVU], std_m, depth_m)


def order_by_thu(std_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    """Order of IHO S-44 by `THU`, from the standard deviations [m] of places along each axis in plan."""
    return _strictest([TO_95_IN_PLAN * std_m <= a + b * depth_m for _, a, b in THU], std_m, depth_m)


def _strictest(meets: list[np.ndarray], std_m: np.ndarray, depth_m: np.ndarray) -> np.ndarray:
    orders = np.select(meets, range(1, len(meets) + 1), default=len(meets) + 1)
    return np.where(np.isfinite(std_m) & (depth_m > 0.0), orders, 0).astype(np.uint8)


def _order(name: str, a: float, b: float, size: np.ndarray, depth: np.ndarray, reference_error: np.ndarray) -> TvuOrder:
    tvu = np.hypot(a, b * depth)
    within, possible = size <= tvu, size <= tvu + reference_error
    band = np.searchsorted(DEPTH_EDGES_M, depth, side="right") - 1
    bands = []
    for i in np.unique(band):
        part = band == i
        shares = float(within[part].mean()), float(possible[part].mean())
        bands.append(TvuBand(DEPTH_EDGES_M[i], DEPTH_EDGES_M[i + 1], int(part.sum()), *shares))
    median = float(np.hypot(a, b * np.median(depth)))
    return TvuOrder(name, median, float(within.mean()), float(possible.mean()), tuple(bands))


def asprs_vertical(residuals: np.ndarray, sigma_m: np.ndarray) -> AsprsAccuracy:
    """Vertical accuracy by residuals (K,) [m], product minus check point, NaN where it does not cover the point.

    ``sigma_m`` (K,) [m] is the standard deviation of each check point's own height. ASPRS Positional Accuracy Standards
    for Digital Geospatial Data, Edition 2: the survey error of the check points is part of the accuracy of the product,
    which is stated as a root mean square and no longer at 95 %.
    """
    covered = np.isfinite(residuals)
    r, sigma = residuals[covered], sigma_m[covered]
    counts = (len(r), int((~covered).sum()), len(r) >= MIN_CHECKPOINTS)
    if not len(r):
        return AsprsAccuracy(*counts)
    fit, own = math.sqrt(np.square(r).mean()), math.sqrt(np.square(sigma).mean())
    return AsprsAccuracy(
        *counts,
        mean_m=float(r.mean()),
        std_m=float(r.std(ddof=1)) if len(r) > 1 else math.nan,
        min_m=float(r.min()),
        max_m=float(r.max()),
        rmse_fit_m=fit,
        rmse_checkpoints_m=own,
        rmse_v_m=math.hypot(fit, own),
    )
