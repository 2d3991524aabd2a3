"""Pictures of a comparison: histogram and map of the distances, map of unreached parts, bias and spread by class."""

import math
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Normalize
from pyproj import CRS

from evaluation import Band
from survey.compare.figures import Comparison, Parts
from survey.compare.tables import limits_label
from survey.display import canvas
from survey.display.palette import BLUE, DIFFERENCES, INK, NOT_REACHED, PALE, RED, SIZES, SOFT
from survey.display.plan_grid import PlanGrid
from survey.display.quantities import LengthUnit, count, length, share

# Points that a cell should have on average: few where a hole is a hole, more where points lie at random.
_POINTS_PER_CELL, _SAMPLES_PER_CELL = 3.0, 6.0
# Cells along the longer side of a map.
_CELLS = 500
# A map of no points: a cell without a value, somewhere.
_NOWHERE = np.full((1, 1), np.nan), (0.0, 1.0, 0.0, 1.0)
# Of bands with fewer points only the number is shown. Bands with less than this share of the points may reach beyond
# the axis, so that the others can be distinguished.
_FEWEST, _SHOWN_WHOLE = 20, 0.001


def drawings_of(comparison: Comparison) -> Iterator[tuple[str, Callable[[Path], canvas.Picture]]]:
    """Names of the pictures of a comparison, and functions that draw them; bands where parts are known."""
    figures, crs = comparison.figures, comparison.inputs.crs
    scores, distances = figures.tolerances[0], figures.distances
    tolerance_m, is_visible = scores.tolerance_m, scores.completeness_visible is not None
    reached = share(scores.completeness_visible if is_visible else scores.completeness)
    in_short = (
        f"inner 90 %: mean {length(distances.mean_inner90_m)}, std {length(distances.std_inner90_m)}  ·  "
        f"{reached} complete at {tolerance_m:g} m{' (visible)' if is_visible else ''}"
    )
    of = f"{reached} of {'the visible points' if is_visible else 'the reference'} closer than {tolerance_m:g} m"
    yield "histogram", lambda path: histogram(comparison.distances, path, tolerance_m=tolerance_m)
    yield "map", lambda path: error_map(comparison.points, comparison.distances, path, crs=crs, subtitle=in_short)
    of_targets = partial(completeness_map, comparison.targets, comparison.is_reached)
    yield "completeness", partial(of_targets, crs=crs, tolerance_m=tolerance_m, subtitle=of)
    if _panels(figures.parts):
        yield "bands", lambda path: draw_bands(figures.parts, path)


def histogram(distances: np.ndarray, path: Path, *, tolerance_m: float | None = None) -> canvas.Picture:
    """Draw how often each distance (N,) [m] occurs, without NaN; the text names the share within a tolerance [m]."""
    d = distances[np.isfinite(distances)]
    limit = canvas.nice_limit(d)
    unit = LengthUnit.of([limit])
    low, num = (-limit, 121) if (d < 0.0).any() else (0.0, 81)
    _, axes = canvas.canvas(7.2, 4.0)
    edges = np.linspace(low, limit, num) * unit.per_metre
    d_in_unit = d * unit.per_metre
    inner = float(np.quantile(np.abs(d_in_unit), 0.9)) if len(d) else math.nan
    axes.axvspan(-inner if low else 0.0, inner, color=PALE, lw=0, label="inner 90 %")
    counts, _ = np.histogram(d_in_unit, bins=edges)
    shares = 100.0 * counts / max(len(d), 1)
    axes.bar(edges[:-1], shares, width=np.diff(edges), align="edge", color=BLUE, lw=0)
    axes.axvline(0.0, color=INK, lw=0.8)
    parts = ["no points"]
    if len(d):
        axes.axvline(d_in_unit.mean(), color=RED, lw=1.4, label=f"mean {length(d.mean())}")
        axes.axvline(np.median(d_in_unit), color=RED, lw=1.4, ls=":", label=f"median {length(np.median(d))}")
        parts = [f"{count(len(d))} points", f"std {length(d.std())}"]
        parts.append(f"{share(np.mean(np.abs(d) > limit))} beyond the axis")
        if tolerance_m is not None:
            parts.append(f"{share(np.mean(np.abs(d) < tolerance_m))} closer than {tolerance_m:g} m")
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel(f"distance to the reference{', above it positive' if low else ''} [{unit.name}]")
    axes.set_ylabel("share of the points [%]")
    axes.legend(loc="upper left" if low else "center right", frameon=False, fontsize=9)
    title, words = "Distance of the cloud to the reference", "Nothing was aligned or shifted before."
    return canvas.finished(axes, path, title, "  ·  ".join(parts), words)


def error_map(
    points: np.ndarray, distances: np.ndarray, path: Path, *, crs: CRS | None = None, subtitle: str = ""
) -> canvas.Picture:
    """Draw signed distances (N,) [m] of points (N, 3), in crs, in plan view: mean per cell, red above and blue below.

    Points with NaN are left out; the crs names the axes and, if geographic, gives their aspect.
    """
    known = np.isfinite(distances)
    points, d = points[known], distances[known]
    limit = canvas.nice_limit(d)
    unit = LengthUnit.of([limit])
    end, is_signed = limit * unit.per_metre, bool((d < 0.0).any())
    axes, image, extent = _map_of_means(points, d * unit.per_metre, _POINTS_PER_CELL, crs)
    norm = Normalize(-end if is_signed else 0.0, end)
    drawn = canvas.show(axes, image, extent, cmap=DIFFERENCES if is_signed else SIZES, norm=norm)
    label = f"{'above (+) or below (−)' if is_signed else 'distance to'} the reference [{unit.name}]"
    canvas.colour_bar(axes, drawn, label, extend="both" if is_signed else "max")
    words = "Red lies above the reference, blue below it."
    return canvas.finished(axes, path, "Distance to the reference in plan view", subtitle, words)


def completeness_map(
    targets: np.ndarray,
    is_reached: np.ndarray,
    path: Path,
    *,
    crs: CRS | None = None,
    tolerance_m: float = 0.2,
    subtitle: str = "",
) -> canvas.Picture:
    """Draw in plan view where the cloud does not reach points (M, 3) of the reference, in crs, in red."""
    axes, image, extent = _map_of_means(targets, 100.0 * (1.0 - is_reached), _SAMPLES_PER_CELL, crs)
    drawn = canvas.show(axes, image, extent, cmap=NOT_REACHED, norm=Normalize(0.0, 100.0))
    canvas.colour_bar(axes, drawn, "not reached [%]", extend="neither")
    axes.set_facecolor("white")
    words = f"Red: no point of the cloud within {tolerance_m:g} m."
    return canvas.finished(axes, path, "What the cloud does not reach", subtitle, words)


def _map_of_means(
    points: np.ndarray, values: np.ndarray, per_cell: float, crs: CRS | None
) -> tuple[Axes, np.ndarray, canvas.Extent]:
    """Axes of a map of points (N, 3), and means (rows, columns) of values (N,) over its cells with their extent."""
    image, extent = _NOWHERE
    if len(points):
        grid = PlanGrid.over(points, crs, max_cells=_CELLS, per_cell=per_cell)
        image, extent = grid.mean(values), grid.extent
    return canvas.map_canvas(extent, crs)[1], image, extent


def _panels(parts: Parts) -> list[tuple[tuple[Band, ...], str, str]]:
    """Bands, label of their axis and unit of their limits, from the attributes of the points."""
    labels = {"depth": "depth below the water [m]", "incidence": "incidence [°]", "views": "views that agree"}
    return [(bands, labels[key], unit) for key, _, unit, bands in parts.banded if key in labels]


def draw_bands(parts: Parts, path: Path) -> canvas.Picture:
    """Mean with its confidence interval, and one standard deviation to both sides, in each band."""
    panels = _panels(parts)
    figure = canvas.empty_figure(11.0, 3.6)
    widths = [len(bands) + 2 for bands, _, _ in panels]
    row = figure.subplots(1, len(panels), sharey=True, squeeze=False, width_ratios=widths)[0]
    # The axis holds zero and the bands with a fair share of the points.
    ends = [0.0]
    for bands, _, _ in panels:
        enough = max(_FEWEST, _SHOWN_WHOLE * sum(band.distances.n_points for band in bands))
        shown = [band.distances for band in bands if band.distances.n_points >= enough]
        ends += [d.mean_m + sign * d.std_m for d in shown for sign in (-1.0, 1.0)]
    margin = 0.1 * max(max(ends) - min(ends), 0.001)
    low, high = min(ends) - margin, max(ends) + margin
    length_unit = LengthUnit.of([low, high])
    for axes, (bands, label, unit) in zip(row, panels, strict=True):
        _panel(axes, bands, unit, length_unit.per_metre)
        axes.set_xlabel(label, color=INK)
    row[0].set_ylabel(f"distance to the reference [{length_unit.name}]", color=INK)
    row[0].set_ylim(low * length_unit.per_metre, high * length_unit.per_metre)
    figure.suptitle("Bias and spread in bands", x=0.01, ha="left", color=INK, fontsize=12, weight="bold")
    handles, labels = row[0].get_legend_handles_labels()
    figure.legend(handles, labels, frameon=False, fontsize=8.5, loc="outside lower center", ncols=3)
    canvas.save(figure, path)
    words = "Mean and spread of the distances in each band, with the number of its points above it."
    return canvas.Picture(path, "Bias and spread by depth, incidence and number of views", words)


def _panel(axes: Axes, bands: tuple[Band, ...], unit: str, per_metre: float) -> None:
    at = np.array([i for i, band in enumerate(bands) if band.distances.n_points >= _FEWEST], dtype=int)
    distances, nothing = [bands[i].distances for i in at], (np.nan, np.nan)
    mean, std, low, high = (
        per_metre * np.array([(d.mean_m, d.std_m, *(d.mean_ci95_m or nothing)) for d in distances]).reshape(-1, 4).T
    )
    axes.bar(at, 2.0 * std, bottom=mean - std, width=0.62, color=BLUE, alpha=0.25, lw=0,
             label="mean ± standard deviation")  # fmt: skip
    if (known := np.isfinite(low)).any():
        axes.vlines(at[known], low[known], high[known], color=RED, lw=2.2, label="95 % confidence of the mean")
    axes.plot(at, mean, "o", ms=4.5, color=RED, label="mean")
    axes.axhline(0.0, color=INK, lw=0.8)
    axes.set_xticks(range(len(bands)), [_tick(limits_label(band.low, band.high, unit)) for band in bands])
    axes.set_xlim(-0.7, len(bands) - 0.3)
    axes.tick_params(colors=SOFT, labelsize=8.5)
    for x, band in enumerate(bands):
        axes.text(x, 1.0, count(band.distances.n_points), transform=axes.get_xaxis_transform(),
                  ha="center", va="bottom", color=SOFT, fontsize=7, rotation=30 if len(bands) > 6 else 0)  # fmt: skip
    axes.spines[["right", "top"]].set_visible(False)


def _tick(label: str) -> str:
    """The label of a band without its unit, which the axis names."""
    # The longest first: " and more" holds " m".
    for word, short in ((" and more", "+"), (" views", ""), (" to ", "–"), (" m", ""), ("°", "")):
        label = label.replace(word, short)
    return label
