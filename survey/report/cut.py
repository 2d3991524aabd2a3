"""The line of the report's profile: that with the most relief."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from survey.display.plan_grid import PlanGrid
from survey.report.facts import ReportFacts

# Cells along the longer side of the bed; lines that are tried: directions, and places across each.
_CELLS, _DIRECTIONS, _PLACES = 200, 12, 41
# A cut that is much shorter than the longest one shows too little of the bed.
_LEAST_LENGTH = 0.6
_RELIEF = (0.02, 0.98)


@dataclass(frozen=True)
class Cut:
    """A straight line in plan.

    Attributes
    ----------
    start : (2,) [m], local
    direction : (2,)
        Unit vector, eastwards, or northwards where it runs north.
    length_m : [m]
    """

    start: np.ndarray
    direction: np.ndarray
    length_m: float

    @property
    def ends(self) -> np.ndarray:
        """Both ends (2, 2) [m], local."""
        return np.array([self.start, self.start + self.length_m * self.direction])

    def along_and_across(self, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (N,) of points (N, 2 or more) [m], local, along the line from its start, and to its left."""
        plan = xy[:, :2] - self.start
        return plan @ self.direction, plan @ np.array([-self.direction[1], self.direction[0]])


def choose_cut(facts: ReportFacts) -> Cut:
    """The cut with the greatest relief under water, or of the ground in a dry survey, among the long ones.

    The bed has to have a point. Dry ground counts as depth zero, so that a cut meets the shore rather than a hill.
    """
    xyz, is_dry = facts.bed.xyz.astype(np.float64, copy=False), facts.survey.water is None
    grid = PlanGrid.over(xyz, None, max_cells=_CELLS)
    relief = grid.mean(xyz[:, 2] if is_dry else np.maximum(facts.bed.depth.astype(np.float64), 0.0))
    west, east, south, north = grid.extent
    centre = np.array([0.5 * (west + east), 0.5 * (south + north)])
    half = 0.5 * float(np.hypot(east - west, north - south))
    steps = np.arange(-half, half, grid.cell_m)
    found = []
    # From the south-east over the east to the north.
    for angle in np.linspace(-0.5 * np.pi, 0.5 * np.pi, _DIRECTIONS, endpoint=False) + np.pi / _DIRECTIONS:
        direction = np.array([np.cos(angle), np.sin(angle)])
        left = np.array([-direction[1], direction[0]])
        for aside in np.linspace(-0.9 * half, 0.9 * half, _PLACES):
            start = centre + aside * left
            values = _along(relief, grid, start + steps[:, None] * direction)
            known = np.flatnonzero(np.isfinite(values))
            if len(known):
                first, last = steps[known[0]], steps[known[-1]]
                height = float(np.diff(np.quantile(values[known], _RELIEF))[0])
                found.append((len(known), height, Cut(start + first * direction, direction, float(last - first))))
    longest = max(length for length, _, _ in found)
    return max((f for f in found if f[0] >= _LEAST_LENGTH * longest), key=lambda f: f[1])[2]


def _along(raster: np.ndarray, grid: PlanGrid, places: np.ndarray) -> np.ndarray:
    """Values (K,) of a raster of a grid at places (K, 2); NaN beyond it."""
    column = np.floor((places[:, 0] - grid.west) / grid.cell[0]).astype(np.int64)
    row = np.floor((grid.north - places[:, 1]) / grid.cell[1]).astype(np.int64)
    rows, columns = raster.shape
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    values = np.full(len(places), np.nan)
    values[inside] = raster[row[inside], column[inside]]
    return values
