"""Tie points: points of the bed measured in several photographs, as every adjustment of this package takes them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class TiePoints:
    """Points of the bed measured in two photographs or more; observations are sorted by point.

    Attributes
    ----------
    start : (M, 3) float64 [m], local
        Where the points are about.
    point : (N,) int64, ascending
        Which point an observation is of; every point has one at least.
    view : (N,) int64
    pixel : (N, 2) float64 [px], img
    """

    start: np.ndarray
    point: np.ndarray
    view: np.ndarray
    pixel: np.ndarray

    def __len__(self) -> int:
        return len(self.start)

    def only(self, keep: np.ndarray) -> TiePoints:
        """The points that have at least three observations left among those to keep, (N,) bool."""
        enough = np.bincount(self.point[keep], minlength=len(self)) >= 3
        keep = keep & enough[self.point]
        number = np.cumsum(enough) - 1
        return TiePoints(self.start[enough], number[self.point[keep]], self.view[keep], self.pixel[keep])
