"""A cut through the bed along its longer side: cloud, reference and water in one picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from survey.compare.canvas import INK, canvas, save, write_title
from survey.report.facts import ReportFacts
from survey.report.shading import Picture

_RED, _BLUE, _WATER = "#c3140d", "#2f6f9f", "#7fb2c6"
# The strip that is looked at, and the steps along it, in ground sampling distances; steps at most.
_STRIP_GSD, _STEP_GSD, _MOST_STEPS = 4.0, 2.0, 600


def draw_profile(path: Path, facts: ReportFacts) -> Picture:
    """Heights along a line through the middle of the cloud: points, their median, the reference, the water.

    The reference is drawn where points of the cloud are near it.
    """
    xyz = facts.bed.xyz
    along, across, ends = _line(xyz)
    strip = np.abs(across) <= 0.5 * _STRIP_GSD * facts.plan.gsd_m
    heights = facts.points_crs[strip, 2]
    figure, axes = canvas(11.0, 3.4)
    axes.plot(along[strip], heights, ".", ms=1.6, color=_BLUE, alpha=0.35, rasterized=True, label="points")
    length_m = float(np.ptp(along[strip])) if strip.any() else 0.0
    step = max(_STEP_GSD * facts.plan.gsd_m, length_m / _MOST_STEPS)
    if facts.comparison is not None:
        reference = _reference_heights(facts, strip)
        axes.plot(*_medians(along[strip], reference, step), color=_RED, lw=1.3, label="reference")
    if facts.survey.water is not None:
        level = facts.survey.frame.crs_from_local(_on_water(facts, ends))[:, 2]
        axes.plot([along.min(), along.max()], level, color=_WATER, lw=2.0, label="water")
    axes.set(xlabel="along the line [m]", ylabel="height [m]")
    axes.yaxis.get_major_formatter().set_useOffset(False)
    axes.legend(frameon=False, fontsize=9, ncols=3, loc="best", markerscale=6.0, labelcolor=INK)
    first, last = (facts.survey.frame.crs_from_local(end)[:2] for end in ends)
    title = "Profile through the middle"
    shown = f"from {first[0]:.8g}, {first[1]:.8g} to {last[0]:.8g}, {last[1]:.8g}"
    width = f"{100.0 * _STRIP_GSD * facts.plan.gsd_m:.0f} cm wide"
    write_title(axes, title, f"{shown}; a strip {width}, heights stretched")
    save(figure, path)
    return Picture(path, title, "Heights of the points in a narrow strip along the longer side of the bed.")


def _line(xyz: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Coordinates (N,) along and across the longer axis of points (N, 3) [m], and its two ends (2, 3)."""
    middle = np.median(xyz, axis=0)
    plan = xyz[:, :2] - middle[:2]
    _, axes = np.linalg.eigh(plan.T @ plan)
    # Eastwards, or northwards where it runs north.
    direction = axes[:, 1] * (-1.0 if axes[np.argmax(np.abs(axes[:, 1])), 1] < 0.0 else 1.0)
    along, across = plan @ direction, plan @ np.array([-direction[1], direction[0]])
    ends = np.array([[*(middle[:2] + s * direction), middle[2]] for s in (along.min(), along.max())])
    return along - along.min(), across, ends


def _reference_heights(facts: ReportFacts, strip: np.ndarray) -> np.ndarray:
    """Height in crs of the reference nearest to each point of the strip, a mask (N,); NaN where none was compared."""
    comparison, inside = facts.comparison, facts.comparison.inputs.inside
    heights = np.full(len(strip), np.nan)
    rows = np.flatnonzero(strip & inside)
    nearest = comparison.nearest[np.cumsum(inside)[rows] - 1]
    heights[rows] = comparison.inputs.frame.crs_from_local(nearest)[:, 2]
    return heights[strip]


def _on_water(facts: ReportFacts, ends: np.ndarray) -> np.ndarray:
    """The ends (2, 3) of the line, moved straight up or down to the water; local."""
    return np.column_stack([ends[:, :2], np.asarray(facts.survey.water.height(ends[:, 0], ends[:, 1]))])


def _medians(along: np.ndarray, values: np.ndarray, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Middle of each step that holds a value, and the median of its values; NaN in gaps of several steps."""
    known = np.isfinite(values)
    cell = np.floor(along[known] / step).astype(np.int64)
    order = np.lexsort((values[known], cell))
    cell, sorted_values = cell[order], values[known][order]
    cells, first, count = np.unique(cell, return_index=True, return_counts=True)
    x = np.full(cells.max(initial=-1) + 1, np.nan)
    y = x.copy()
    x[cells], y[cells] = (cells + 0.5) * step, sorted_values[first + count // 2]
    return x, y
