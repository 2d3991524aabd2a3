"""Tie points: points of the ground measured in several photographs, as the adjustment takes them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

# Two photographs may agree by chance on a false point; a third rarely does.
MIN_TRACK = 3


@dataclass(frozen=True)
class TiePoints:
    """Points of the ground measured in several photographs; observations are sorted by point.

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

    def renumbered(self, views: np.ndarray) -> TiePoints:
        """The same points with view ``i`` as number ``views[i]``."""
        return replace(self, view=views[self.view])

    def only(self, keep: np.ndarray) -> TiePoints:
        """The points that have at least `MIN_TRACK` observations left among those to keep, (N,) bool."""
        enough = np.bincount(self.point[keep], minlength=len(self)) >= MIN_TRACK
        keep = keep & enough[self.point]
        number = np.cumsum(enough) - 1
        return TiePoints(self.start[enough], number[self.point[keep]], self.view[keep], self.pixel[keep])
