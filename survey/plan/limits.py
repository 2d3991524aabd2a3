"""Limits that a cloud has to meet: of its quality gate, and of what an adjustment may leave open."""

from __future__ import annotations

from evaluation.standards import TO_95, TVU

# Of the standard deviation that points have of their own, in ground sampling distances.
MAX_STD_GSD = 1.5
# Of the standard deviation of a height with all that it shares: that of IHO S-44's strictest order in shallow water,
# 77 mm, where one and a half ground sampling distances are less.
STRICTEST_ORDER_M = TVU[0][1] / TO_95


def max_height_std(gsd_m: float) -> float:
    """Largest standard deviation [m] of a height, all included, at a ground sampling distance [m]."""
    return max(MAX_STD_GSD * gsd_m, STRICTEST_ORDER_M)
