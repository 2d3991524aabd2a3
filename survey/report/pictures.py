"""The pictures of a report, drawn one after the other into PNG files; those that are histograms and graphs."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from geo.crs import height_unit_m
from survey.adjust.result.std_of_block import part_numbers
from survey.compare import pictures as compare_report
from survey.compare.canvas import canvas, nice_limit, plain_log_ticks, save
from survey.display.column import finite, median
from survey.display.palette import BLUE, INK, RED, SERIES, SOFT
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import NO_BREAK, LengthUnit, number
from survey.report import adjustment_pictures, flight, maps, profile
from survey.report.adjustment_figures import correlations
from survey.report.facts import ReportFacts
from survey.report.raster import Picture, finished

if TYPE_CHECKING:
    from survey.adjust.result.adjustment import Adjustment
    from survey.compare.figures import Comparison

# Cells of a map along the longer side, at most: a picture has some 800 pixels for them.
_MAP_CELLS = 900
_CELL_GSD = 2.0
_BANDS, _FEWEST = 16, 20
_STD = "standard deviation"


def draw_pictures(folder: Path, facts: ReportFacts) -> Iterator[Picture]:
    """Draw the pictures that the facts allow as PNG files in a folder that exists, in the order of the report.

    Each is drawn when it is asked for, and written whole or not at all.
    """
    return (draw(folder / f"{name}.png") for name, draw in drawings_of(facts).items())


def drawings_of(facts: ReportFacts) -> dict[str, Callable[[Path], Picture]]:
    """Functions that draw the pictures which the facts allow, by name, in the order of the report."""
    drawings: dict[str, Callable[[Path], Picture]] = {}
    if len(facts.bed):
        cell_m = _CELL_GSD * facts.plan.gsd_m
        grid = PlanGrid.over(facts.points_crs, facts.survey.frame.crs, cell_m=cell_m, max_cells=_MAP_CELLS)
        line = profile.choose_cut(facts)
        cut = line if profile.has_profile(facts, line) else None
        drawings["depth"] = partial(maps.draw_surface, facts=facts, grid=grid, cut=cut)
        drawings["orthophoto"] = partial(maps.draw_orthophoto, facts=facts, grid=grid)
        if cut is not None:
            drawings["profile"] = partial(profile.draw_profile, facts=facts, cut=cut)
    if facts.comparison is not None:
        drawings |= _of_comparison(facts, facts.comparison)
    if facts.height_maps:
        drawings["view"] = partial(maps.draw_view, facts=facts, height_maps=facts.height_maps)
    if len(facts.bed):
        drawings["unseen"] = partial(maps.draw_unseen, facts=facts)
        drawings["views"] = partial(maps.draw_num_views, facts=facts, grid=grid)
        drawings["std"] = partial(maps.draw_std, facts=facts, grid=grid)
        drawings["histograms"] = partial(draw_histograms, facts=facts)
    if facts.adjustment is not None:
        drawings |= _of_adjustment(facts, facts.adjustment)
    residuals = adjustment_pictures.residuals_of(facts.survey, facts.adjustment, facts.checkpoints)
    if residuals:
        drawings["control"] = partial(adjustment_pictures.draw_residuals, survey=facts.survey, residuals=residuals)
    if facts.surfaces is not None and len(facts.bed):
        drawings["waves"] = partial(maps.draw_waves, facts=facts, surfaces=facts.surfaces)
    drawings["plan"] = partial(flight.draw_plan, facts=facts)
    return drawings


def _of_adjustment(facts: ReportFacts, found: Adjustment) -> dict[str, Callable[[Path], Picture]]:
    drawings: dict[str, Callable[[Path], Picture]] = {}
    if part_numbers(found).max() > 0:
        drawings["parts"] = partial(adjustment_pictures.draw_parts, survey=facts.survey, found=found)
    drawings |= {
        "residuals_ground": partial(adjustment_pictures.draw_ground_residuals, survey=facts.survey, found=found),
        "residuals_image": partial(adjustment_pictures.draw_image_residuals, found=found),
    }
    # Two parameters of water and lenses at least were estimated.
    if len(correlations(found)[0]) > 1:
        drawings["correlation"] = partial(adjustment_pictures.draw_correlation, found=found)
    return drawings


def _of_comparison(facts: ReportFacts, comparison: Comparison) -> dict[str, Callable[[Path], Picture]]:
    crs = facts.survey.frame.crs
    tolerance_m = comparison.figures.tolerances[0].tolerance_m

    def error_map(path: Path) -> Picture:
        compare_report.error_map(comparison.points, comparison.distances, path, crs=crs)
        return Picture(path, "Distance to the reference", "Red lies above the reference, blue below it.")

    def histogram(path: Path) -> Picture:
        compare_report.histogram(comparison.distances, path, tolerance_m=tolerance_m)
        words = "Nothing was aligned or shifted before."
        return Picture(path, "Distribution of the distance to the reference", words)

    def completeness(path: Path) -> Picture:
        compare_report.completeness_map(comparison.targets, comparison.is_reached, path, crs=crs)
        words = f"Red: no point of the cloud within {tolerance_m:g} m."
        return Picture(path, "What the cloud does not reach", words)

    def bands(path: Path) -> Picture:
        compare_report.draw_bands(comparison.figures.parts, path)
        words = "Mean and spread of the distances in each band, with the number of its points above it."
        return Picture(path, "Bias and spread by depth, incidence and number of views", words)

    drawings: dict[str, Callable[[Path], Picture]] = {
        "error": error_map,
        "error_histogram": histogram,
        "completeness": completeness,
    }
    distances = comparison.distances_of_cloud
    if np.isfinite(distances).any():
        drawings["error_depth"] = partial(draw_error_over_depth, facts=facts, distances=distances)
    if compare_report.has_bands(comparison.figures.parts):
        drawings["error_bands"] = bands
    return drawings


def draw_histograms(path: Path, facts: ReportFacts) -> Picture:
    """Distributions of depth, spread, views and incidence over the points."""
    bed = facts.bed
    is_dry = facts.survey.water is None
    std = LengthUnit.of([median(bed.std)])
    tall = LengthUnit.of_heights()
    up = tall.per_metre * height_unit_m(facts.survey.frame.crs)
    angle = "angle off nadir" if is_dry else "incidence at the water"
    graphs = (
        ("height", tall.name, tall.decimals, up, facts.points_crs[:, 2])
        if is_dry
        else ("true depth", tall.name, tall.decimals, tall.per_metre, bed.depth),
        (_STD, std.name, std.decimals, std.per_metre, bed.std),
        ("views that agree", "", 0, 1.0, bed.num_views),
        (angle, "°", 1, math.degrees(1.0), bed.incidence),
    )
    # Two by two: four in a row cannot be read on a phone.
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, graph, colour in zip(figure.subplots(2, 2).flat, graphs, SERIES, strict=True):
        label, unit, decimals, scale, column = graph
        # One at a time: columns have hundreds of millions of values.
        values = finite(column, bed.wet if column is bed.depth else None)
        if len(values):
            middle = _histogram(axes, values, scale, colour, is_count=not unit, is_log=label == _STD)
            gap = NO_BREAK if unit not in ("", "°") else ""
            axes.set_title(f"median {number(middle, decimals)}{gap}{unit}", loc="right", color=SOFT, fontsize=9)
        axes.set(yticks=[])
        axes.set_xlabel(f"{label} [{unit}]" if unit else label, color=INK)
        axes.tick_params(colors=SOFT, labelsize=8.5)
        axes.spines[["left", "right", "top"]].set_visible(False)
    save(figure, path)
    return Picture(path, "Distributions", "Over all points; the dark lines mark the medians.")


def _histogram(axes: Axes, values: np.ndarray, scale: float, colour: str, *, is_count: bool, is_log: bool) -> float:
    """Shares of values times a scale in bins of equal width or ratio, or of one whole number each; and the median."""
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=is_count))
    low, high, top, middle = (scale * np.quantile(values, (0.002, 0.998, 0.995, 0.5))).tolist()
    high = high if high > low else low + 1.0
    if is_count:
        edges = np.arange(0.5, top + 1.0)
    elif is_log and low > 0.0:
        edges = np.geomspace(low, high, 61)
        axes.set_xscale("log")
        plain_log_ticks(axes.xaxis)
    else:
        edges = np.linspace(low, high, 61)
    counts = np.histogram(values, edges / scale)[0]
    axes.hist(edges[:-1], edges.tolist(), weights=counts, color=colour, rwidth=0.85 if is_count else 1.0)
    axes.axvline(middle, color=INK, lw=1.2)
    return middle


def draw_error_over_depth(path: Path, facts: ReportFacts, distances: np.ndarray) -> Picture:
    """Median and inner 68 % of the distances (N,) [m] to a reference, in bands of depth or of height."""
    is_dry = facts.survey.water is None
    shown = LengthUnit.of_heights()
    up = height_unit_m(facts.survey.frame.crs)
    along = np.asarray(facts.points_crs[:, 2] * up if is_dry else facts.bed.depth, dtype=np.float64) * shown.per_metre
    use = np.isfinite(distances) & np.isfinite(along)
    along, distances = along[use], distances[use]
    limit = nice_limit(distances)
    unit = LengthUnit.of([limit])
    _, axes = canvas(7.2, 3.4)
    if along.size:
        low, high = np.quantile(along, [0.002, 0.998])
        edges = np.linspace(low, high, _BANDS + 1)
        band = np.digitize(along, edges)
        parts = [(i, distances[band == i]) for i in range(1, len(edges))]
        rows = [
            (0.5 * (edges[i - 1] + edges[i]), *np.quantile(part, [0.16, 0.5, 0.84]))
            for i, part in parts
            if len(part) >= _FEWEST
        ]
        if rows:
            middle, low, median, high = np.array(rows).T * [[1.0], *[[unit.per_metre]] * 3]
            axes.fill_between(middle, low, high, color=BLUE, alpha=0.25, lw=0, label="inner 68 %")
            axes.plot(middle, median, "o-", ms=3.5, color=RED, lw=1.3, label="median")
            axes.legend(frameon=False, fontsize=9, ncols=2, loc="upper right")
        axes.set_ylim(-limit * unit.per_metre, limit * unit.per_metre)
    axes.axhline(0.0, color=INK, lw=0.8)
    ground = ", dry ground negative" if (along < 0.0).any() else ""
    name = f"{'height' if is_dry else f'true depth below the water{ground}'} [{shown.name}]"
    axes.set(xlabel=name, ylabel=f"distance to the reference [{unit.name}]")
    title = f"Distance to the reference over {'height' if is_dry else 'depth'}"
    words = "A line that stays at zero means that no part of the depth is scaled wrongly."
    return finished(axes, path, title, f"bands with at least {_FEWEST} points", words)
