"""Stated uncertainty of the cloud: LE90, and the orders of IHO S-44 that this would meet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evaluation.standards import TVU, order_by_tvu
from survey.display.quantities import count, length, share
from survey.report.blocks import Block, Rows, Text

# 90 % of normal errors are within so many standard deviations: along one axis, and in two that are alike.
LE90, CE90 = 1.644854, 2.145966
_SHARE = 0.95
_NOTE = (
    "By the standard deviations that the cloud states, random and shared, taken as those of normal errors; nothing is "
    "compared, which check points or a reference would do. An order of IHO S-44 (Ed. 6.1.0) also asks for horizontal "
    "uncertainty, coverage and feature detection."
)


@dataclass(frozen=True)
class StatedOrder:
    """An order of IHO S-44."""

    name: str
    # [-]: share of the points under water whose stated uncertainty at 95 % is at most the one that the order allows
    share_within: float


@dataclass(frozen=True)
class StatedFigures:
    """Uncertainty that the cloud states of the heights of its points."""

    # [m]: median of 1.645 standard deviations, random and shared: the error of a height that 90 % are below
    le90_m: float
    points_wet: int
    orders: tuple[StatedOrder, ...]  # The strictest first; none without points under water

    @property
    def strictest(self) -> StatedOrder | None:
        """The first order for 95 % of the points; None where there is none."""
        return next((order for order in self.orders if order.share_within >= _SHARE), None)


def stated_of(std_m: np.ndarray, depth_m: np.ndarray) -> StatedFigures | None:
    """The figures of points with standard deviations (N,) [m] of their heights, at depths (N,) [m]; None of no points.

    Depths are positive under water; NaN counts for nothing.
    """
    known = np.isfinite(std_m)
    if not known.any():
        return None
    orders = order_by_tvu(std_m, depth_m)
    wet = orders[orders > 0]
    shares = [
        StatedOrder(name, float((wet <= number).mean())) for number, (name, _, _) in enumerate(TVU, start=1) if len(wet)
    ]
    return StatedFigures(LE90 * float(np.median(std_m[known])), len(wet), tuple(shares))


def table(found: StatedFigures | None) -> list[Block]:
    """LE90, and how many points each order takes; nothing without points."""
    if found is None:
        return []
    rows = [("height, 90 % (LE90), median", length(found.le90_m))]
    rows += [
        (
            f"IHO S-44, vertical, {order.name}",
            f"{share(order.share_within)} of {count(found.points_wet)} points under water",
        )
        for order in found.orders
    ]
    return [Rows(rows), Text(_NOTE, is_soft=True)]
