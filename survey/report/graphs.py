"""Histograms of the points, and distance to a reference over depth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from survey.compare.canvas import canvas, nice_limit, plain_log_ticks, save, write_title
from survey.display.palette import BLUE, INK, RED, SERIES, SOFT
from survey.display.quantities import LengthUnit, number, with_unit
from survey.report.facts import ReportFacts
from survey.report.shading import Picture

_BANDS, _FEWEST = 16, 20
_STD = "standard deviation"


def draw_histograms(path: Path, facts: ReportFacts) -> Picture:
    """Distributions of depth, spread, views and incidence over the points."""
    bed = facts.bed
    is_dry = facts.survey.water is None
    std = LengthUnit.of([float(np.nanmedian(bed.std))] if np.isfinite(bed.std).any() else [])
    angle = "angle off nadir" if is_dry else "incidence at the water"
    graphs = (
        ("height", "m", 2, facts.points_crs[:, 2]) if is_dry else ("true depth", "m", 2, bed.depth[bed.wet]),
        (_STD, std.name, std.decimals, std.per_metre * bed.std),
        ("views that agree", "", 0, bed.num_views),
        (angle, "°", 1, np.degrees(bed.incidence)),
    )
    # Two by two: four in a row cannot be read on a phone.
    figure = Figure(figsize=(7.2, 4.6), layout="constrained")
    FigureCanvasAgg(figure)
    for axes, (label, unit, decimals, values), colour in zip(figure.subplots(2, 2).flat, graphs, SERIES, strict=True):
        values = values[np.isfinite(values)].astype(np.float64)
        if values.size:
            _histogram(axes, values, colour, is_count=not unit, is_log=label == _STD)
            median = with_unit(number(float(np.median(values)), decimals), unit)
            axes.set_title(f"median {median}", loc="right", color=SOFT, fontsize=9)
        axes.set(yticks=[])
        axes.set_xlabel(f"{label} [{unit}]" if unit else label, color=INK)
        axes.tick_params(colors=SOFT, labelsize=8.5)
        axes.spines[["left", "right", "top"]].set_visible(False)
    save(figure, path)
    return Picture(path, "Distributions", "Over all points; the dark lines mark the medians.")


def _histogram(axes: Axes, values: np.ndarray, colour: str, *, is_count: bool, is_log: bool) -> None:
    """Shares of values in bins of equal width or ratio, or one for each whole number if they count; and the median."""
    axes.xaxis.set_major_locator(MaxNLocator(4, integer=is_count))
    low, high = np.quantile(values, [0.002, 0.998])
    high = high if high > low else low + 1.0
    if is_count:
        edges = np.arange(0.5, np.quantile(values, 0.995) + 1.0)
    elif is_log and low > 0.0:
        edges = np.geomspace(low, high, 61)
        axes.set_xscale("log")
        plain_log_ticks(axes.xaxis)
    else:
        edges = np.linspace(low, high, 61)
    axes.hist(values, edges.tolist(), color=colour, rwidth=0.85 if is_count else 1.0)
    axes.axvline(float(np.median(values)), color=INK, lw=1.2)


def draw_error_over_depth(path: Path, facts: ReportFacts, distances: np.ndarray) -> Picture:
    """Median and inner 68 % of the distances (N,) [m] to a reference, in bands of depth or of height."""
    is_dry = facts.survey.water is None
    along = np.asarray(facts.points_crs[:, 2] if is_dry else facts.bed.depth, dtype=np.float64)
    use = np.isfinite(distances) & np.isfinite(along)
    along, distances = along[use], distances[use]
    limit = nice_limit(distances)
    unit = LengthUnit.of([limit])
    figure, axes = canvas(7.2, 3.4)
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
    name = "height [m]" if is_dry else f"true depth below the water{ground} [m]"
    axes.set(xlabel=name, ylabel=f"distance to the reference [{unit.name}]")
    title = f"Distance to the reference over {'height' if is_dry else 'depth'}"
    write_title(axes, title, f"bands with at least {_FEWEST} points")
    save(figure, path)
    return Picture(path, title, "A line that stays at zero means that no part of the depth is scaled wrongly.")
