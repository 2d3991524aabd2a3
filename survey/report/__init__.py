"""The report of a run: one set of figures, for machines as report.json and for people as report.html; its pictures."""

import math
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.ticker import MaxNLocator

from geo.crs import height_unit_m
from geo.files import write_text
from survey.adjust.result.parts import part_numbers
from survey.compare.pictures import drawings_of
from survey.display.canvas import Picture, empty_figure, plain_log_ticks, save
from survey.display.palette import INK, SERIES, SOFT
from survey.display.plan_grid import PlanGrid, finite, median
from survey.display.quantities import NO_BREAK, LengthUnit, number
from survey.files.json_values import write_json
from survey.report import flight_pictures, maps, profile
from survey.report.adjustment import correlations
from survey.report.facts import ReportFacts
from survey.report.figures import ReportFigures, figures_of, json_of
from survey.report.page import render_page

__all__ = ["NUM_STEPS", "ReportFacts", "write_report"]

# How often `write_report` calls back, at most: once for each picture.
NUM_STEPS = 19
# Cells of a map along the longer side, at most: a picture has some 800 pixels for them.
_MAP_CELLS = 900
_CELL_GSD = 2.0
_STD = "standard deviation"


def write_report(folder: Path, facts: ReportFacts, advance: Callable[[], None] = lambda: None) -> ReportFigures:
    """Write pictures/, report.json and report.html into the folder of a run; each file is written whole or not at all.

    `advance` is called after each picture. Returns what the page and report.json show.
    """
    (folder / "pictures").mkdir(exist_ok=True)
    figures = figures_of(facts)
    pictures = []
    for name, draw in _drawings(facts):
        pictures.append(draw(folder / "pictures" / f"{name}.png"))
        advance()
    page = render_page(figures, pictures)
    write_json(folder / "report.json", json_of(figures))
    write_text(folder / "report.html", page)
    return figures


def _drawings(facts: ReportFacts) -> Iterator[tuple[str, Callable[[Path], Picture]]]:
    """Names of the pictures which the facts allow, and functions that draw them."""
    survey, comparison, has_points = facts.survey, facts.comparison, len(facts.bed) > 0
    if has_points:
        cell_m = _CELL_GSD * facts.plan.gsd_m
        grid = PlanGrid.over(facts.points_crs, survey.frame.crs, cell_m=cell_m, max_cells=_MAP_CELLS)
        line = profile.choose_cut(facts)
        cut = line if profile.has_profile(facts, line) else None
        yield "depth", lambda path: maps.draw_surface(path, facts, grid, cut)
        yield "orthophoto", lambda path: maps.draw_orthophoto(path, facts, grid)
        if cut is not None:
            yield "profile", lambda path: profile.draw_profile(path, facts, cut)
    if comparison is not None:
        names = {"map": "error", "histogram": "error_histogram", "bands": "error_bands"}
        yield from ((names.get(name, name), draw) for name, draw in drawings_of(comparison))
    if facts.height_maps:
        yield "view", lambda path: maps.draw_view(path, facts, facts.height_maps or ())
    if has_points:
        yield "unseen", lambda path: maps.draw_unseen(path, facts)
        yield "views", lambda path: maps.draw_num_views(path, facts, grid)
        yield "std", lambda path: maps.draw_std(path, facts, grid)
        yield "histograms", lambda path: draw_histograms(path, facts)
    if (found := facts.adjustment) is not None:
        if part_numbers(found).max() > 0:
            yield "parts", lambda path: flight_pictures.draw_parts(path, survey, found)
        yield "residuals_ground", lambda path: flight_pictures.draw_ground_residuals(path, survey, found)
        yield "residuals_image", lambda path: flight_pictures.draw_image_residuals(path, found)
        # Two parameters of water and lenses at least were estimated.
        if len(correlations(found)[0]) > 1:
            yield "correlation", lambda path: flight_pictures.draw_correlation(path, found)
    if residuals := flight_pictures.residuals_of(survey, facts.adjustment, facts.checkpoints):
        yield "control", lambda path: flight_pictures.draw_residuals(path, survey, residuals)
    if (surfaces := facts.surfaces) is not None and has_points:
        yield "waves", lambda path: maps.draw_waves(path, facts, surfaces)
        yield "wave_shifts", lambda path: maps.draw_wave_shifts(path, facts, surfaces)
    yield "plan", lambda path: flight_pictures.draw_plan(path, facts)


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
    figure = empty_figure(7.2, 4.6)
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
