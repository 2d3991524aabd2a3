"""Tie points: points of the ground measured in several photographs, as the adjustment takes them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

# Two photographs may agree by chance on a false point; a third rarely does.
MIN_TRACK = 3


def least_track(num_views: int) -> int:
    """Observations that a point has at least in a block of so many photographs: of two, two."""
    return min(MIN_TRACK, num_views)


@dataclass(frozen=True)
class TiePoints:
    """Points of the ground measured in several photographs; observations are sorted by point."""

    start: np.ndarray  # (M, 3) float64 [m], local: where the points are about
    point: np.ndarray  # (N,) int64, ascending: which point an observation is of; every point has one at least
    view: np.ndarray  # (N,) int64
    pixel: np.ndarray  # (N, 2) float64 [px], img
    least: int = MIN_TRACK  # Observations that a point is to have; see `least_track`

    def __len__(self) -> int:
        return len(self.start)

    def renumbered(self, views: np.ndarray) -> TiePoints:
        """The same points with view ``i`` as number ``views[i]``."""
        return replace(self, view=views[self.view])

    @classmethod
    def together(cls, parts: Sequence[TiePoints]) -> TiePoints:
        """The points of several parts, one after the other; views are numbered alike in all."""
        first = np.cumsum([0, *(len(part) for part in parts)])
        return cls(
            np.concatenate([part.start for part in parts]),
            np.concatenate([part.point + shift for shift, part in zip(first, parts, strict=False)]),
            np.concatenate([part.view for part in parts]),
            np.concatenate([part.pixel for part in parts]),
            min((part.least for part in parts), default=MIN_TRACK),
        )

    def only(self, keep: np.ndarray) -> TiePoints:
        """The points that have at least `least` observations left among those to keep, (N,) bool."""
        enough = np.bincount(self.point[keep], minlength=len(self)) >= self.least
        keep = keep & enough[self.point]
        number = np.cumsum(enough) - 1
        kept = (self.start[enough], number[self.point[keep]], self.view[keep], self.pixel[keep])
        return TiePoints(*kept, self.least)


def parts_of(num_views: int, point: np.ndarray, view: np.ndarray) -> np.ndarray:
    """Connected component (num_views,) int64 of each view, by shared points.

    Observations (N,) are of points and of views. Parts are numbered from the largest, that with most views, on; of
    equal ones the one with the first view comes first. A view that sees nothing is in part -1.
    """
    num_points = int(point.max()) + 1 if len(point) else 0
    nodes = num_views + num_points
    seen = coo_array((np.ones(len(view), dtype=bool), (view, num_views + point)), shape=(nodes, nodes))
    label = connected_components(seen, directed=False)[1][:num_views]
    is_seen = np.bincount(view, minlength=num_views) > 0
    of_seen, first, size = np.unique(label[is_seen], return_index=True, return_counts=True)
    part = np.full(num_views, -1, dtype=np.int64)
    for number, k in enumerate(np.lexsort([first, -size])):
        part[is_seen & (label == of_seen[k])] = number
    return part
