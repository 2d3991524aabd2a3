"""Standard deviation of heights by cells of the ground, and its dominant part.

It is the random std of the points, which more processing reduces; std_common comes on top of it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from survey.plan.aim import SHARE

if TYPE_CHECKING:
    from fields.sweep.bed import BedPoints

# Side of a cell in ground sampling distances.
_CELL_GSD = 10.0
# Places that fewer views see than this have too few heights to average.
_FEW_VIEWS = 4.0
# What may keep cells above, in words.
FEW, DEPTH, NOISE = "few photographs", "depth", "noise, texture and relief below the pixel"


@dataclass(frozen=True)
class CellStd:
    """Cells of the ground that have points; K of them, medians over their points."""

    xyz: np.ndarray  # (K, 3) [m], local: a point of each
    std: np.ndarray  # (K,) [m]
    num_views: np.ndarray  # (K,)
    depth: np.ndarray  # (K,) [m]: of water; NaN in a dry survey

    def __len__(self) -> int:
        return len(self.std)

    def reached(self, std_m: float, factor: float = 1.0) -> float:
        """Share of the cells within a standard deviation [m] with theirs scaled by a factor; 1 without cells."""
        return float((factor * self.std <= std_m).mean()) if len(self) else 1.0

    def limit(self, std_m: float) -> str:
        """Dominant part of the standard deviation of most cells above the target."""
        above = self.std > std_m
        few = above & (self.num_views < _FEW_VIEWS)
        if 2 * few.sum() > above.sum():
            return FEW
        within = self.depth[~above]
        if within.size and np.isfinite(within).any() and above.any():
            deeper = np.nanmedian(self.depth[above & ~few]) > np.nanquantile(within, 0.75)
            return DEPTH if deeper else NOISE
        return NOISE

    def in_words(self, std_m: float) -> str:
        """Share that was reached, in words."""
        if not len(self):
            return "no ground has points"
        most = 1e3 * float(np.quantile(self.std, SHARE))
        return (
            f"{100 * self.reached(std_m):.1f} % of the ground has a std of at most {1e3 * std_m:.1f} mm; "
            f"{100 * SHARE:g} % of it has at most {most:.1f} mm"
        )


def std_cells(bed: BedPoints, gsd: float) -> CellStd:
    """Cells of points of the bed; ``gsd`` [m] is the ground sampling distance."""
    use = np.isfinite(bed.std)
    place = np.floor(bed.xyz[use, :2] / (_CELL_GSD * gsd)).astype(np.int64)
    _, first, cell = np.unique(place, axis=0, return_index=True, return_inverse=True)
    columns = (_medians(cell.ravel(), each[use].astype(np.float64)) for each in (bed.std, bed.num_views, bed.depth))
    return CellStd(bed.xyz[use][first], *columns)


def _medians(cell: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The lower median of the values of each cell, numbered from zero."""
    order = np.lexsort((values, cell))
    ends = np.append(np.flatnonzero(np.diff(cell[order])) + 1, len(cell))
    starts = np.concatenate([[0], ends[:-1]])
    return values[order][(starts + ends - 1) // 2] if len(cell) else np.empty(0)
