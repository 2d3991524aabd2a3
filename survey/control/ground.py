"""Dry ground of an earlier survey, in local: control by a surface in place of marked points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Ground:
    """Points of ground that did not change since they were surveyed.

    Attributes
    ----------
    points : (N, 3) float64 [m], local
    std_m : (horizontal, vertical) [m]
        Standard deviation of a shift that all of them share.
    """

    points: np.ndarray
    std_m: tuple[float, float]
