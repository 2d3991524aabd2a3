"""Points seen from above, binned into square cells, for maps and the area that they cover; values of columns."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from pyproj import CRS

from evaluation.bootstrap import cell_numbers
from geo.grid import Grid
from geo.projection import ground_units_m
from geo.shapes import ComputedColumn, portions

# Strays: points beyond this share of the outermost ones on each side, by more than this share of the extent. They must
# not shrink the picture of all others.
_STRAY_SHARE = 0.001
_MARGIN = 0.05
# Points that suffice to find the extent of all.
_ENOUGH = 200_000
# Points whose cells are worked out at a time, of 100 bytes each: the cells of all points are never held.
_PORTION = 100_000
# Factor on the side of a cell: the outermost point lies inside the last cell, not on its edge.
_EDGE_FACTOR = 1.0 + 1e-6
# Points per cell on average, so that a hole in a map is a hole in the cloud and not one by chance.
_POINTS_PER_CELL = 3.0
_SMALLEST_CELL_M = 1e-6


@dataclass(frozen=True)
class PlanGrid(Grid):
    """A grid in plan, with rows from north to south, and the points in it."""

    plan: np.ndarray = field(repr=False)  # (N, 2) in crs: which may lie in a file

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
        cell_m = max(cell_m, _EDGE_FACTOR * float(side_m.max()) / max_cells, sparse_m, _SMALLEST_CELL_M)
        return PlanGrid.within(plan, low, high, cell_m, crs)

    @staticmethod
    def within(
        points: np.ndarray, low: np.ndarray, high: np.ndarray, cell_m: float, crs: CRS | None = None
    ) -> PlanGrid:
        """The grid between two corners (2,), whatever the points (N, 2 or more) in crs; those beyond it are strays."""
        return PlanGrid(**vars(Grid.southward_from(low, high, cell_m, crs)), plan=points[:, :2])

    def _portions(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Parts of the points, and the cell (M,) int64 of each point, row by row; -1 for strays beyond the grid."""
        for part in portions(len(self.plan), _PORTION):
            yield part, cell_numbers(self.columns_rows(self.plan[part]), self.shape)

    @property
    def covered_m2(self) -> float:
        """Area of the cells that hold a point [m²]; cells without one are never held."""
        held = np.unique(np.concatenate([np.unique(number) for _, number in self._portions()]))
        return int(np.count_nonzero(held >= 0)) * self.side_m**2

    def count(self, mask: np.ndarray | None = None) -> np.ndarray:
        """Points in each cell, of those in a ``mask`` (N,) bool."""
        count = np.zeros(self.shape, dtype=np.int64)
        for part, number in self._portions():
            np.add.at(count.reshape(-1), number[number >= 0 if mask is None else (number >= 0) & mask[part]], 1)
        return count

    def mean(self, values: np.ndarray | ComputedColumn, mask: np.ndarray | None = None) -> np.ndarray:
        """Mean of values (N,) in each cell, NaN where there is none; values that are NaN do not count."""
        count, total = np.zeros(self.shape, dtype=np.int64), np.zeros(self.shape)
        for part, number in self._portions():
            portion = np.asarray(values[part], dtype=np.float64)
            use = (number >= 0) & np.isfinite(portion)
            if mask is not None:
                use &= mask[part]
            np.add.at(count.reshape(-1), number[use], 1)
            np.add.at(total.reshape(-1), number[use], portion[use])
        with np.errstate(invalid="ignore"):
            total /= count
        return total

    def highest(self, height: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values (N, ...) of the highest point of each cell, (rows, columns, ...), NaN where none.

        They are float64, of small whole numbers float32. Points without a height do not count.
        """
        cells = self.shape[0] * self.shape[1]
        kind = np.result_type(values.dtype, np.float32)
        top, found = np.full(cells, -np.inf), np.full((cells, *values.shape[1:]), np.nan, dtype=kind)
        for part, number in self._portions():
            portion = np.asarray(height[part])
            number = np.where(np.isfinite(portion), number, -1)
            order = np.argsort(portion, kind="stable")
            # From the highest down, the first point of each cell.
            cell, last = np.unique(number[order][::-1], return_index=True)
            point = order[::-1][last]
            higher = (cell >= 0) & ~(portion[point] < top[cell])
            cell, point = cell[higher], point[higher]
            top[cell], found[cell] = portion[point], values[part][point]
        return found.reshape(*self.shape, *values.shape[1:])


def finite(values: np.ndarray | ComputedColumn, mask: np.ndarray | None = None) -> np.ndarray:
    """The finite values (n,) of a column (N,), of those in a ``mask`` (N,) bool: float64, of smaller ones float32."""
    kept = [np.zeros(0, dtype=np.float32)]
    for rows in portions(len(values)):
        part = np.asarray(values[rows])
        keep = np.isfinite(part) if mask is None else np.isfinite(part) & mask[rows]
        kept.append(part[keep].astype(np.result_type(part, np.float32)))
    return np.concatenate(kept)


def median(values: np.ndarray | ComputedColumn, mask: np.ndarray | None = None) -> float:
    """The median of the finite values of a column (N,); NaN where there is none."""
    known = finite(values, mask)
    return float(np.median(known, overwrite_input=True)) if len(known) else math.nan
