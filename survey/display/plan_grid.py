"""Points seen from above, binned into square cells: for maps, and for the area that they cover."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from evaluation.bootstrap import cell_counts, cell_means, cell_numbers
from geo.projection import ground_units_m

# A few stray points must not shrink the picture of all others.
_STRAY_SHARE = 0.001
_MARGIN = 0.05
# Points that suffice to find the extent of all.
_ENOUGH = 200_000
# Points whose cells are worked out at a time, of 60 bytes each.
_PORTION = 500_000
# So that the outermost point, on the edge of the last cell, does not need a further one.
_A_LITTLE_MORE = 1.0 + 1e-6
# So that a hole in a map is a hole in the cloud, and not one by chance.
_POINTS_PER_CELL = 3.0
_SMALLEST_CELL_M = 1e-6


@dataclass(frozen=True)
class PlanGrid:
    """Square cells in plan; rows run from north to south."""

    # west, north in crs: outer corner of the first cell
    west: float
    north: float
    cell: tuple[float, float]  # (east, north), in units of crs
    cell_m: float  # [m]
    shape: tuple[int, int]  # (rows, columns)
    index: np.ndarray  # (N,) int64: cell of each point, row by row; -1 for strays beyond the grid

    @staticmethod
    def over(
        points_crs: np.ndarray,
        crs: CRS | None,
        *,
        max_cells: int,
        cell_m: float = 0.0,
        per_cell: float = _POINTS_PER_CELL,
    ) -> PlanGrid:
        """The grid of a map of points (N, 3) in crs, N at least 1; without a crs, in metres.

        Cells have ``cell_m`` [m], and are made larger where there would be more than ``max_cells`` along a side, or
        fewer than ``per_cell`` points in each on average. Points that lie beyond the outermost 0.1 % by more than a
        twentieth of the extent are strays.
        """
        plan = points_crs[:, :2]
        unit = np.ones(2) if crs is None else ground_units_m(crs, plan[0])
        some = plan[:: len(plan) // _ENOUGH + 1]
        low, high = np.quantile(some, [_STRAY_SHARE, 1.0 - _STRAY_SHARE], axis=0)
        margin = _MARGIN * (high - low)
        low, high = np.maximum(low - margin, plan.min(axis=0)), np.minimum(high + margin, plan.max(axis=0))
        side_m = (high - low) * unit
        sparse_m = math.sqrt(per_cell * float(side_m.prod()) / len(plan))
        cell_m = max(cell_m, _A_LITTLE_MORE * float(side_m.max()) / max_cells, sparse_m, _SMALLEST_CELL_M)
        return PlanGrid._between(plan, low, high, unit, cell_m)

    @staticmethod
    def of_cells(points_m: np.ndarray, cell_m: float) -> PlanGrid:
        """The grid over all points (N, 2 or more) [m], strays too, with cells of exactly this size."""
        plan = points_m[:, :2]
        return PlanGrid._between(plan, plan.min(axis=0), plan.max(axis=0), np.ones(2), cell_m)

    @staticmethod
    def within(points_m: np.ndarray, low: np.ndarray, high: np.ndarray, cell_m: float) -> PlanGrid:
        """The grid between two corners (2,) [m], whatever the points (N, 2 or more) [m]; those beyond it are strays."""
        return PlanGrid._between(points_m[:, :2], low, high, np.ones(2), cell_m)

    @staticmethod
    def _between(plan: np.ndarray, low: np.ndarray, high: np.ndarray, unit: np.ndarray, cell_m: float) -> PlanGrid:
        """Cells from the north-western corner of what lies between ``low`` and ``high`` (2,) in crs."""
        columns, rows = (math.floor(side / cell_m) + 1 for side in (high - low) * unit)
        cell = cell_m / unit
        index = np.empty(len(plan), dtype=np.int64)
        for first in range(0, len(plan), _PORTION):
            x, y = plan[first : first + _PORTION].T
            at = np.column_stack([(x - low[0]) / cell[0], (high[1] - y) / cell[1]])
            index[first : first + _PORTION] = cell_numbers(at, (rows, columns))
        corner = (float(low[0]), float(high[1]))
        return PlanGrid(*corner, (float(cell[0]), float(cell[1])), cell_m, (rows, columns), index)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north of the outer edges, in crs, as matplotlib takes them."""
        rows, columns = self.shape
        return (
            self.west,
            self.west + columns * self.cell[0],
            self.north - rows * self.cell[1],
            self.north,
        )

    @property
    def covered_m2(self) -> float:
        """Area of the cells that hold a point [m²]; no array of all cells is made."""
        return len(np.unique(self.index[self.index >= 0])) * self.cell_m**2

    def count(self, among: np.ndarray | None = None) -> np.ndarray:
        """Points in each cell, of those ``among`` (N,) bool."""
        return cell_counts(self.index if among is None else self.index[among], self.shape)

    def mean(self, values: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
        """Mean of values (N,) in each cell, NaN where there is none; values that are NaN do not count."""
        if among is None:
            return cell_means(self.index, values, self.shape)
        return cell_means(self.index[among], values[among], self.shape)

    def highest(self, height: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values (N, ...) of the highest point of each cell, (rows, columns, ...) float64; NaN where none."""
        order = np.argsort(height, kind="stable")
        order = order[self.index[order] >= 0]
        top = np.full((self.shape[0] * self.shape[1], *values.shape[1:]), np.nan)
        # Of points in one cell the last one assigned stays.
        top[self.index[order]] = values[order]
        return top.reshape(*self.shape, *values.shape[1:])
