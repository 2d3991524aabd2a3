"""Profile of the bed along the line with the most relief: water, bed, points and reference."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from evaluation.bootstrap import cell_numbers
from geo.crs import height_unit_m, is_geographic
from geo.shapes import ComputedColumn, portions
from survey.display.canvas import Picture, canvas, figure_of, finished, lay_out
from survey.display.palette import BLUE, INK, LAND, RED, WATER, WATER_LINE
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import NO_BREAK, LengthUnit, length, number
from survey.report.facts import ReportFacts

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
class Cut:
    """A straight line in plan."""

    start: np.ndarray  # (2,) [m], local
    direction: np.ndarray  # (2,): unit vector, eastwards, or northwards where it runs north
    length_m: float  # [m]

    @property
    def ends(self) -> np.ndarray:
        """First and last place (2, 2) [m], local."""
        return np.stack([self.start, self.start + self.length_m * self.direction])

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
    steps, cuts = np.arange(-half, half, grid.side_m), []
    # From the south-east over the east to the north.
    for angle in np.linspace(-0.5 * np.pi, 0.5 * np.pi, _DIRECTIONS, endpoint=False) + np.pi / _DIRECTIONS:
        direction = np.array([np.cos(angle), np.sin(angle)])
        for offset in np.linspace(-0.9 * half, 0.9 * half, _PLACES):
            start = centre + offset * np.array([-direction[1], direction[0]])
            cell = cell_numbers(grid.columns_rows(start + steps[:, None] * direction), relief.shape)
            values = np.where(cell >= 0, relief.ravel()[cell], np.nan)
            known = np.flatnonzero(np.isfinite(values))
            if len(known):
                first, last = steps[known[0]], steps[known[-1]]
                height = float(np.diff(np.quantile(values[known], _RELIEF))[0])
                cuts.append((len(known), height, Cut(start + first * direction, direction, float(last - first))))
    longest = max(num for num, _, _ in cuts)
    return max((cut for cut in cuts if cut[0] >= _LEAST_LENGTH * longest), key=lambda cut: cut[1])[2]


def has_profile(facts: ReportFacts, cut: Cut) -> bool:
    """Whether enough of a cut has points near it for its picture to show the bed."""
    rows, along, step_m = _strip(facts, cut)
    num_known = np.count_nonzero(np.isfinite(_medians(along, facts.points_crs[rows, 2], step_m)[1]))
    return bool(num_known >= max(_FEWEST_STEPS, _LEAST_SHARE * cut.length_m / step_m))


def _strip(facts: ReportFacts, cut: Cut) -> tuple[np.ndarray, np.ndarray, float]:
    """Numbers (K,) of the points near a cut, how far along they lie [m], and the step of its medians [m]."""
    rows, half_m = [], 0.5 * _STRIP_GSD * facts.plan.gsd_m
    for part in portions(len(facts.bed)):
        along, across = cut.along_and_across(facts.bed.xyz[part])
        # Half a cell of the grid that chose the cut may lie beside it.
        inside = (np.abs(across) <= half_m) & (along >= 0.0) & (along <= cut.length_m)
        rows.append(part.start + np.flatnonzero(inside))
    near = np.concatenate(rows)
    step_m = max(_STEP_GSD * facts.plan.gsd_m, cut.length_m / _MOST_STEPS)
    return near, cut.along_and_across(facts.bed.xyz[near])[0], step_m


def draw_profile(path: Path, facts: ReportFacts, cut: Cut) -> Picture:
    """Heights along a cut: the points near it, the bed as their median, the water over it, the reference.

    The reference is drawn where points of the cloud are near it.
    """
    rows, along, step = _strip(facts, cut)
    unit, crs = LengthUnit.of_heights(), facts.survey.frame.crs
    up = height_unit_m(crs) * unit.per_metre
    along, step, end = along * unit.per_metre, step * unit.per_metre, cut.length_m * unit.per_metre
    heights, ends = facts.points_crs[rows, 2] * up, np.column_stack([cut.ends, np.zeros(2)])
    _, axes = canvas(11.0, 3.8)
    axes.set_xlim(0.0, max(end, step))
    x, bed = _medians(along, heights, step)
    shown, level = np.quantile(heights, [0.002, 0.998]) if len(heights) else np.zeros(2), np.full(len(x), np.nan)
    if (water := facts.survey.water) is not None:
        ends[:, 2] = water.height(*cut.ends.T)
        level = np.interp(x, [0.0, end], facts.survey.frame.crs_from_local(ends)[:, 2] * up)
        shown = np.append(shown, level)
        wet = np.flatnonzero(bed < level)
        middle = wet[len(wet) // 2] if len(wet) else len(x) // 2
        label = f"▽ water {number(level[middle], 2)}{NO_BREAK}{unit.name}"
        axes.text(x[middle], level[middle], label, color=WATER_LINE, fontsize=9, ha="center", va="bottom", zorder=5)
    low, high = float(shown.min()), float(shown.max())
    size = max(high - low, 0.01)
    axes.set_ylim(low - _BELOW * size, high + _ABOVE * size)
    reference = np.full(len(x), np.nan)
    if facts.comparison is not None:
        known = _medians(along, facts.comparison.reference_heights(rows) * up, step)[1]
        reference[: len(known)] = known
    draw_section(axes, x, bed, level, reference)
    axes.plot(along, heights, ".", ms=1.8, color=BLUE, alpha=0.4, rasterized=True, label="points", zorder=2)
    axes.set(xlabel=f"along the line from A to B [{unit.name}]", ylabel=f"height [{unit.name}]")
    axes.ticklabel_format(axis="y", useOffset=False)
    axes.legend(frameon=False, fontsize=9, ncols=4, loc="lower right", bbox_to_anchor=(1.0, 1.0), markerscale=6.0,
                labelcolor=INK)  # fmt: skip
    for x_end, name, side in ((0.0, "A", "left"), (1.0, "B", "right")):
        axes.text(x_end, 0.97, f" {name} ", transform=axes.transAxes, ha=side, va="top", color=INK, weight="bold")
    lay_out(figure_of(axes))
    box, (x0, x1), (y0, y1) = axes.get_window_extent(), axes.get_xlim(), axes.get_ylim()
    stretch = (box.height / (y1 - y0)) / (box.width / (x1 - x0))
    subtitle = (
        f"a strip {length(_STRIP_GSD * facts.plan.gsd_m)} wide, heights drawn {two_digits(stretch)} times as large as "
        "lengths"
    )
    decimals = 7 if is_geographic(crs) else 2
    first, last = (", ".join(number(value, decimals) for value in place) for place in _ends_in_crs(facts, cut))
    what = "the ground" if water is None else "the bed under water"
    words = f"Where {what} changes most along a line: from A ({first}) to B ({last})."
    return finished(axes, path, "Profile from A to B", subtitle, words)


def draw_line(axes: Axes, facts: ReportFacts, cut: Cut) -> None:
    """Line of the profile, drawn into a map."""
    ends = _ends_in_crs(facts, cut)
    axes.plot(*ends.T, color="white", lw=2.4, alpha=0.7, zorder=4)
    axes.plot(*ends.T, color=INK, lw=1.0, ls=(0, (5, 3)), zorder=5)
    for (x, y), name in zip(ends, "AB", strict=True):
        frame = {"boxstyle": "circle,pad=0.18", "fc": "white", "ec": INK, "lw": 0.8}
        axes.text(x, y, name, ha="center", va="center", fontsize=8, color=INK, bbox=frame, zorder=6, clip_on=False)


def _ends_in_crs(facts: ReportFacts, cut: Cut) -> np.ndarray:
    return facts.survey.frame.crs_from_local(np.column_stack([cut.ends, np.zeros(2)]))[:, :2]


def draw_section(axes: Axes, x: np.ndarray, bed: np.ndarray, level: np.ndarray, reference: np.ndarray) -> None:
    """The ground under a bed (K,), the water over it up to its level, and a reference; NaN where one is not known."""
    if np.isfinite(level).any():
        is_wet = bed < level
        axes.fill_between(x, bed, level, where=is_wet, color=WATER, alpha=0.45, lw=0, zorder=1)
        # Over a bed that is dry all along, the level beside it still says how high it lies.
        shown = np.where(bed >= level, np.nan, level) if is_wet.any() else level
        axes.plot(x, shown, color=WATER_LINE, lw=1.8, label="water", zorder=3)
    axes.fill_between(x, bed, axes.get_ylim()[0], color=LAND, lw=0, zorder=1)
    axes.plot(x, bed, color=INK, lw=1.1, label="bed", zorder=3)
    if np.isfinite(reference).any():
        axes.plot(x, reference, color=RED, lw=1.3, label="reference", zorder=4)


def two_digits(value: float) -> str:
    """A positive factor in two digits, and never with an exponent: 1.8, 18, 180."""
    rounded = float(f"{value:.2g}")
    return f"{rounded:.0f}" if rounded >= 10.0 else f"{rounded:.12g}"


def _medians(along: np.ndarray, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each step up to the last with a value, and the median of its values; NaN where it has none."""
    known = np.isfinite(values)
    cell = np.floor(along[known] / step).astype(np.int64)
    order = np.lexsort((values[known], cell))
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    x = (np.arange(cells.max(initial=-1) + 1) + 0.5) * step
    y = np.full(len(x), np.nan)
    y[cells] = values[known][order][first + count // 2]
    return x, y
