"""Profile of the bed along the line with the most relief: water, bed, points and reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes

from evaluation.bootstrap import cell_numbers
from geo.crs import height_unit_m, is_geographic
from geo.shapes import ComputedColumn, portions
from survey.compare.canvas import canvas, figure_of, lay_out
from survey.display.palette import BLUE, INK, LAND, RED, WATER, WATER_LINE
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import NO_BREAK, LengthUnit, length, number
from survey.report.facts import ReportFacts
from survey.report.raster import Picture, finished

if TYPE_CHECKING:
    from survey.compare.figures import Comparison

# Width of the strip, and steps along it, in ground sampling distances; the most steps.
_STRIP_GSD, _STEP_GSD, _MOST_STEPS = 4.0, 2.0, 600
# A profile needs points in so many steps, and in this share of all along its line.
_FEWEST_STEPS, _LEAST_SHARE = 10, 0.2
# Empty space above and below, in parts of the heights that are shown.
_ABOVE, _BELOW = 0.18, 0.12
# Cells along the longer side of the bed; lines that are tried: directions, and places across each.
_CELLS, _DIRECTIONS, _PLACES = 200, 12, 41
# A cut that is much shorter than the longest one shows too little of the bed.
_LEAST_LENGTH = 0.6
_RELIEF = (0.02, 0.98)


@dataclass(frozen=True)
class _Strip:
    """The points near a cut."""

    width_m: float  # [m]
    rows: np.ndarray  # (K,) int64: numbers of the points of the bed that lie in it
    # along, heights (K,) [m]: from the start of the cut, and heights in crs
    along: np.ndarray
    heights: np.ndarray
    step_m: float  # [m]: over which heights are gathered


def has_profile(facts: ReportFacts, cut: Cut) -> bool:
    """Whether enough of a cut has points near it for its picture to show the bed."""
    strip = _strip(facts, cut)
    _, bed = _medians(strip.along, strip.heights, strip.step_m)
    num_known = np.count_nonzero(np.isfinite(bed))
    return bool(num_known >= max(_FEWEST_STEPS, _LEAST_SHARE * cut.length_m / strip.step_m))


def _strip(facts: ReportFacts, cut: Cut) -> _Strip:
    width_m = _STRIP_GSD * facts.plan.gsd_m
    found = []
    for part in portions(len(facts.bed)):
        along, across = cut.along_and_across(facts.bed.xyz[part])
        # Half a cell of the grid that chose the cut may lie beside it.
        inside = (np.abs(across) <= 0.5 * width_m) & (along >= 0.0) & (along <= cut.length_m)
        found.append(part.start + np.flatnonzero(inside))
    rows = np.concatenate(found)
    step_m = max(_STEP_GSD * facts.plan.gsd_m, cut.length_m / _MOST_STEPS)
    return _Strip(width_m, rows, cut.along_and_across(facts.bed.xyz[rows])[0], facts.points_crs[rows, 2], step_m)


def draw_profile(path: Path, facts: ReportFacts, cut: Cut) -> Picture:
    """Heights along a cut: the points near it, the bed as their median, the water over it, the reference.

    The reference is drawn where points of the cloud are near it.
    """
    strip = _strip(facts, cut)
    unit = LengthUnit.of_heights()
    up = height_unit_m(facts.survey.frame.crs) * unit.per_metre
    along, heights, step = strip.along * unit.per_metre, strip.heights * up, strip.step_m * unit.per_metre
    end = cut.length_m * unit.per_metre
    _, axes = canvas(11.0, 3.8)
    axes.set_xlim(0.0, max(end, step))
    x, bed = _medians(along, heights, step)
    ends_of_level = _level(facts, cut)
    level = None if ends_of_level is None else np.interp(x, [0.0, end], ends_of_level * up)
    _set_heights(axes, heights, None if ends_of_level is None else ends_of_level * up)
    if level is not None:
        _draw_water(axes, x, bed, level, unit)
    axes.fill_between(x, bed, axes.get_ylim()[0], color=LAND, lw=0, zorder=1)
    axes.plot(x, bed, color=INK, lw=1.1, label="bed", zorder=3)
    axes.plot(along, heights, ".", ms=1.8, color=BLUE, alpha=0.4, rasterized=True, label="points", zorder=2)
    if facts.comparison is not None:
        reference = _reference_heights(facts.comparison, strip.rows) * up
        axes.plot(*_medians(along, reference, step), color=RED, lw=1.3, label="reference", zorder=4)
    axes.set(xlabel=f"along the line from A to B [{unit.name}]", ylabel=f"height [{unit.name}]")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(frameon=False, fontsize=9, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), markerscale=6.0,
                labelcolor=INK)  # fmt: skip
    for x_end, name, side in ((0.0, "A", "left"), (1.0, "B", "right")):
        axes.text(x_end, 0.97, f" {name} ", transform=axes.transAxes, ha=side, va="top", color=INK, weight="bold")
    lay_out(figure_of(axes))
    box, (x0, x1), (y0, y1) = axes.get_window_extent(), axes.get_xlim(), axes.get_ylim()
    stretch = (box.height / (y1 - y0)) / (box.width / (x1 - x0))
    scale = f"heights drawn {two_digits(stretch)} times as large as lengths"
    ends = facts.survey.frame.crs_from_local(np.column_stack([cut.ends, np.zeros(2)]))[:, :2]
    decimals = 7 if is_geographic(facts.survey.frame.crs) else 2
    first, last = (", ".join(number(value, decimals) for value in end) for end in ends)
    what = "the ground" if level is None else "the bed under water"
    words = f"Where {what} changes most along a line: from A ({first}) to B ({last})."
    return finished(axes, path, "Profile from A to B", f"a strip {length(strip.width_m)} wide, {scale}", words)


def draw_line(axes: Axes, facts: ReportFacts, cut: Cut) -> None:
    """Line of the profile, drawn into a map."""
    ends = facts.survey.frame.crs_from_local(np.column_stack([cut.ends, np.zeros(2)]))[:, :2]
    axes.plot(*ends.T, color="white", lw=2.4, alpha=0.7, zorder=4)
    axes.plot(*ends.T, color=INK, lw=1.0, ls=(0, (5, 3)), zorder=5)
    for (x, y), name in zip(ends, "AB", strict=True):
        frame = {"boxstyle": "circle,pad=0.18", "fc": "white", "ec": INK, "lw": 0.8}
        axes.text(x, y, name, ha="center", va="center", fontsize=8, color=INK, bbox=frame, zorder=6, clip_on=False)


def _level(facts: ReportFacts, cut: Cut) -> np.ndarray | None:
    """Height (2,) of the water in crs at both ends of the cut; None for a dry survey."""
    water = facts.survey.water
    if water is None:
        return None
    on_water = np.column_stack([cut.ends, np.asarray(water.height(*cut.ends.T))])
    return facts.survey.frame.crs_from_local(on_water)[:, 2]


def _set_heights(axes: Axes, heights: np.ndarray, level: np.ndarray | None) -> None:
    """Limits of the axis of heights, which hold the bed without its strays, and the water."""
    shown = np.quantile(heights, [0.002, 0.998]) if len(heights) else np.zeros(2)
    if level is not None:
        shown = np.append(shown, [level.min(), level.max()])
    low, high = float(shown.min()), float(shown.max())
    size = max(high - low, 0.01)
    axes.set_ylim(low - _BELOW * size, high + _ABOVE * size)


def _draw_water(axes: Axes, x: np.ndarray, bed: np.ndarray, level: np.ndarray, unit: LengthUnit) -> None:
    """Water between bed and surface, and its level in words."""
    wet = np.flatnonzero(bed < level)
    axes.fill_between(x, bed, level, where=bed < level, color=WATER, alpha=0.45, lw=0, zorder=1)
    # Over a bed that is dry all along the cut, the level beside it still says how high it lies.
    shown = np.where(bed >= level, np.nan, level) if len(wet) else level
    axes.plot(x, shown, color=WATER_LINE, lw=1.8, label="water", zorder=3)
    middle = wet[len(wet) // 2] if len(wet) else len(x) // 2
    label = f"▽ water {number(level[middle], 2)}{NO_BREAK}{unit.name}"
    axes.text(x[middle], level[middle], label, color=WATER_LINE, fontsize=9, ha="center", va="bottom", zorder=5)


def two_digits(value: float) -> str:
    """A positive factor in two digits, and never with an exponent: 1.8, 18, 180."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:.0f}" if rounded >= 10.0 else f"{rounded:.12g}"


def _reference_heights(comparison: Comparison, rows: np.ndarray) -> np.ndarray:
    """Height (K,) in crs of the reference nearest to the points of some rows (K,); NaN where none was compared."""
    inside = comparison.inputs.inside
    heights, is_compared = np.full(len(rows), np.nan), inside[rows]
    nearest = comparison.nearest[np.cumsum(inside)[rows[is_compared]] - 1]
    heights[is_compared] = comparison.inputs.frame.crs_from_local(nearest)[:, 2]
    return heights


def _medians(along: np.ndarray, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each step up to the last with a value, and the median of its values; NaN where it has none."""
    known = np.isfinite(values)
    cell = np.floor(along[known] / step).astype(np.int64)
    order = np.lexsort((values[known], cell))
    cell, sorted_values = cell[order], values[known][order]
    cells, first, count = np.unique(cell, return_index=True, return_counts=True)
    x = (np.arange(cells.max(initial=-1) + 1) + 0.5) * step
    y = np.full(len(x), np.nan)
    y[cells] = sorted_values[first + count // 2]
    return x, y


@dataclass(frozen=True)
class Cut:
    """A straight line in plan."""

    start: np.ndarray  # (2,) [m], local
    direction: np.ndarray  # (2,): unit vector, eastwards, or northwards where it runs north
    length_m: float  # [m]

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
    xyz, is_dry = facts.bed.xyz, facts.survey.water is None
    grid = PlanGrid.over(xyz, None, max_cells=_CELLS)
    relief = grid.mean(xyz[:, 2] if is_dry else ComputedColumn(lambda depth: np.maximum(depth, 0.0), facts.bed.depth))
    west, east, south, north = grid.extent
    centre = np.array([0.5 * (west + east), 0.5 * (south + north)])
    half = 0.5 * float(np.hypot(east - west, north - south))
    steps = np.arange(-half, half, grid.side_m)
    found = []
    # From the south-east over the east to the north.
    for angle in np.linspace(-0.5 * np.pi, 0.5 * np.pi, _DIRECTIONS, endpoint=False) + np.pi / _DIRECTIONS:
        direction = np.array([np.cos(angle), np.sin(angle)])
        left = np.array([-direction[1], direction[0]])
        for offset in np.linspace(-0.9 * half, 0.9 * half, _PLACES):
            start = centre + offset * left
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
    number = cell_numbers(grid.columns_rows(places), raster.shape)
    return np.where(number >= 0, raster.ravel()[number], np.nan)
