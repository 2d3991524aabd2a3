"""Canvases of the pictures of a comparison: colours, axes in plan view, cells, scale bar.

Drawn without a display, on figures of their own: nothing of matplotlib's global state is used or changed.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import Colormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator, ScalarFormatter
from pyproj import CRS

from geo import write_whole
from geo.crs import is_geographic

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Extent = tuple[float, float, float, float]

INK, SOFT, EMPTY = "#22303c", "#6b7885", "#d9dde1"
_DPI = 140
# Share of |d| that the colours and the histogram span; the rest has the colour of the end.
_SHOWN = 0.98
# Cells along the longer side of a map.
_CELLS = 500
# A few stray points must not shrink the picture of all others.
_STRAY_SHARE, _MARGIN = 0.001, 0.05
_EARTH_RADIUS_M = 6.371e6
# Height over width of a map; long narrow surveys get empty margins, so that title and ticks have room.
_FLATTEST, _TALLEST = 0.3, 1.5
_BAR_WIDTH_IN = 0.2


def nice_limit(distances: np.ndarray) -> float:
    """End of an axis for distances (N,) [m]: the 0.98 quantile of |d|, rounded up to a round number."""
    size = np.abs(distances[np.isfinite(distances)])
    quantile = float(np.quantile(size, _SHOWN)) if len(size) else 0.0
    if quantile <= 0.0:
        return 0.001
    power = 10.0 ** math.floor(math.log10(quantile))
    return next(step * power for step in (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0) if step * power >= quantile * (1 - 1e-9))


def mean_per_cell(points: np.ndarray, values: np.ndarray, per_cell: float) -> tuple[np.ndarray, Extent]:
    """Means over square cells in plan view.

    Parameters
    ----------
    points : (N, 3), in crs
        Those beyond the outermost 0.1 % by more than a twentieth of the extent are left out as strays.
    values : (N,)
    per_cell : float
        Points that a cell should hold on average; there are at most 500 cells along a side.

    Returns
    -------
    means : (rows, columns), south first
        NaN in cells without a point.
    extent : (e0, e1, n0, n1), in crs
    """
    plan = points[:, :2]
    if not len(plan):
        return np.full((1, 1), np.nan), (0.0, 1.0, 0.0, 1.0)
    low, high = np.quantile(plan, [_STRAY_SHARE, 1.0 - _STRAY_SHARE], axis=0)
    margin = _MARGIN * (high - low)
    kept = ((plan >= low - margin) & (plan <= high + margin)).all(axis=1)
    plan, values = plan[kept], values[kept]
    low, high = plan.min(axis=0), plan.max(axis=0)
    # Points on a line or on one spot still need a cell of some size.
    size = np.maximum(high - low, 1e-9 * np.maximum(np.abs(high), 1.0))
    size = np.maximum(size, 1e-3 * size.max())
    cell = max(size.max() / _CELLS, math.sqrt(size.prod() * per_cell / len(plan)))
    shape = np.ceil(size / cell).astype(np.int64)
    at = np.floor((plan - low) / cell).astype(np.int64)
    at = np.minimum(at, shape - 1)
    flat = at[:, 1] * shape[0] + at[:, 0]
    counts = np.bincount(flat, minlength=shape.prod())
    sums = np.bincount(flat, weights=values, minlength=shape.prod())
    means = np.divide(sums, counts, out=np.full(len(sums), np.nan), where=counts > 0)
    east, north = low + shape * cell
    return means.reshape(shape[1], shape[0]), (float(low[0]), float(east), float(low[1]), float(north))


def draw_cells(
    image: np.ndarray,
    extent: Extent,
    crs: CRS | None,
    *,
    colours: str | Colormap,
    limits: tuple[float, float],
    label: str,
    extend: str = "neither",
) -> tuple[Figure, Axes]:
    """A map of cells as `mean_per_cell` gives them, with a bar of its colours between two limits."""
    figure, axes = _map_canvas(extent, crs)
    limits_e, limits_n = axes.get_xlim(), axes.get_ylim()
    drawn = axes.imshow(
        image,
        origin="lower",
        extent=extent,
        cmap=colours,
        vmin=limits[0],
        vmax=limits[1],
        interpolation="nearest",
        aspect=axes.get_aspect(),
    )
    axes.set(xlim=limits_e, ylim=limits_n)
    beside = axes.inset_axes([1.025, 0.06, _BAR_WIDTH_IN / (axes.bbox.width / figure.dpi), 0.88])
    bar = figure.colorbar(drawn, cax=beside, extend=extend)
    bar.set_label(label, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=SOFT, labelsize=8.5)
    return figure, axes


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure [inch] with one plot in the colours of the report."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.tick_params(colors=SOFT, labelsize=8.5)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(SOFT)
    return figure, axes


def _map_canvas(extent: Extent, crs: CRS | None) -> tuple[Figure, Axes]:
    """Axes in easting and northing, or longitude and latitude, true to scale, with a bar of metres."""
    angular = crs is not None and is_geographic(crs)
    aspect = 1.0 / max(math.cos(math.radians(0.5 * (extent[2] + extent[3]))), 0.01) if angular else 1.0
    centre = 0.5 * (extent[0] + extent[1]), 0.5 * (extent[2] + extent[3])
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    width = max(width, height * aspect / _TALLEST)
    height = max(height, width / aspect * _FLATTEST)
    figure, axes = canvas(*_size_for(height * aspect / width))
    axes.set_facecolor(EMPTY)
    axes.set_aspect(aspect, adjustable="box")
    axes.set_xlim(centre[0] - 0.5 * width, centre[0] + 0.5 * width)
    axes.set_ylim(centre[1] - 0.5 * height, centre[1] + 0.5 * height)
    unit = crs.axis_info[0].unit_name if crs is not None else "m"
    unit = {"metre": "m", "degree": "°"}.get(unit, unit)
    axes.set_xlabel(f"{'longitude' if angular else 'easting'} [{unit}]")
    axes.set_ylabel(f"{'latitude' if angular else 'northing'} [{unit}]")
    for axis, count in ((axes.xaxis, 5), (axes.yaxis, 7)):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
        axis.set_major_formatter(ScalarFormatter(useOffset=False))
        axis.get_major_formatter().set_scientific(False)
    unit_m = crs.axis_info[0].unit_conversion_factor if crs is not None else 1.0
    _scale_bar(axes, unit_m * _EARTH_RADIUS_M / aspect if angular else unit_m)
    return figure, axes


def _size_for(height_over_width: float) -> tuple[float, float]:
    """Size [inch] of a figure whose map is at most 6.4 inches wide and 7.2 high, with room for the rest."""
    width = min(6.4, 7.2 / height_over_width)
    return width + 2.4, width * height_over_width + 1.3


def _scale_bar(axes: Axes, metres_per_unit: float) -> None:
    """A bar of a round number of metres, about a sixth of the width, in the lower left corner."""
    west, east = axes.get_xlim()
    width_m = (east - west) * metres_per_unit
    power = 10.0 ** math.floor(math.log10(width_m / 6.0))
    length_m = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= width_m / 6.0)
    share = length_m / width_m
    across = axes.get_xaxis_transform()
    start = west + 0.04 * (east - west)
    end = start + share * (east - west)
    axes.plot([start, end], [0.03, 0.03], transform=across, color="white", lw=6, solid_capstyle="butt", zorder=5)
    axes.plot([start, end], [0.03, 0.03], transform=across, color=INK, lw=3, solid_capstyle="butt", zorder=6)
    axes.text(
        0.5 * (start + end),
        0.042,
        f"{length_m:g} m",
        transform=across,
        ha="center",
        va="bottom",
        color=INK,
        fontsize=9,
        zorder=6,
        path_effects=[withStroke(linewidth=3, foreground="white")],
    )


def write_title(axes: Axes, title: str, subtitle: str = "") -> None:
    """A title, and a smaller line below it."""
    axes.set_title(title, loc="left", color=INK, fontsize=12, pad=22 if subtitle else 10, weight="bold")
    if subtitle:
        axes.text(0.0, 1.0, subtitle, transform=axes.transAxes, va="bottom", color=SOFT, fontsize=9.5)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all; raises UnwritableFile."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI)
    with write_whole(path) as stream:
        stream.write(buffer.getvalue())


def length_text(value_m: float) -> str:
    """A length [m] as 12.3 mm or 1.234 m, with a true minus sign."""
    text = f"{value_m * 1000.0:.1f} mm" if abs(value_m) < 0.5 else f"{value_m:.3f} m"
    return text.replace("-", "−")
