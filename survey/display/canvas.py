"""Canvases of pictures: plots, maps true to scale with a scale bar, colour bars.

Drawn without a display, on separate figures: matplotlib's global state is neither used nor changed.
"""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.figure import Figure
from matplotlib.image import AxesImage, PcolorImage
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullFormatter, ScalarFormatter
from matplotlib.transforms import Bbox
from pyproj import CRS

from geo import write_whole
from geo.crs import EARTH_RADIUS_M, is_geographic
from geo.projection import ground_units_m
from survey.display.palette import EMPTY, INK, SOFT
from survey.display.quantities import round_up
from survey.words import figure_text

Extent = tuple[float, float, float, float]

_DPI, _COMPRESSION = 170, 3
# Width and height of the largest map [inch]: small, so that its words can still be read at half the width of a page.
_MAP_IN = (4.8, 5.4)
# Margins left, right, below and above: for ticks and labels, a bar of colours, a title of two lines.
_MARGINS_IN = (1.0, 1.05, 0.6, 0.6)
_TICK_PT = 8.5
# Share of |d| that the colours and the histogram span; the rest is clipped to the end.
_SHOWN = 0.98
# Height over width of a map; long narrow surveys get empty margins, so that title and ticks have room.
_FLATTEST, _TALLEST = 0.3, 1.5
_BAR_WIDTH_IN = 0.2
# Side of the mark of a point [pt].
_POINT_PT = 8.0


def nice_limit(distances: np.ndarray) -> float:
    """End of an axis for distances (N,) [m]: the 0.98 quantile of |d|, rounded up to a round number."""
    size = np.abs(distances[np.isfinite(distances)])
    quantile = float(np.quantile(size, _SHOWN)) if len(size) else 0.0
    if quantile <= 0.0:
        return 0.001
    return round_up(quantile, (1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0))


def show(axes: Axes, image: np.ndarray, extent: Extent, **colours) -> AxesImage:
    """Draw a raster, its first row in the north, into axes in crs, whose limits stay as they are."""
    west, east, south, north = extent
    rows, columns = image.shape[:2]
    edges = np.linspace(west, east, columns + 1), np.linspace(south, north, rows + 1)
    # What `imshow` makes resamples colours in floating point, with 60 bytes a cell.
    drawn = PcolorImage(axes, *edges, image[::-1], zorder=1, **colours)
    axes.add_image(drawn)
    return drawn


def colour_bar(axes: Axes, scale: ScalarMappable, label: str, *, extend: str = "both") -> Colorbar:
    """A colour bar beside axes."""
    figure = axes.figure
    bar_axes = axes.inset_axes((1.025, 0.06, _BAR_WIDTH_IN / (axes.bbox.width / figure.dpi), 0.88))
    bar = figure.colorbar(scale, cax=bar_axes, extend=extend)
    bar.set_label(label, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=SOFT, labelsize=_TICK_PT)
    return bar


def plain_log_ticks(axis: Axis) -> None:
    """Ticks at 1, 2 and 5 of each decade of a logarithmic axis, as plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.set_minor_formatter(NullFormatter())


def empty_figure(width: float, height: float) -> Figure:
    """A figure [inch] for plots side by side."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def canvas(width: float, height: float) -> tuple[Figure, Axes]:
    """A figure [inch] with one plot in the colours of the report."""
    figure = empty_figure(width, height)
    return figure, plain(figure.add_subplot())


def extent_around(places: np.ndarray, crs: CRS, share: float) -> Extent:
    """West, east, south, north of places (N, 2) in crs, with a margin: a share of the longer side on the ground."""
    low, high = places.min(axis=0), places.max(axis=0)
    unit_m = ground_units_m(crs, places[0])
    margin = share * max(float(((high - low) * unit_m).max()), 1.0) / unit_m
    (west, south), (east, north) = (low - margin).tolist(), (high + margin).tolist()
    return (west, east, south, north)


def map_canvas(extent: Extent, crs: CRS | None, *, below_in: float = 0.0) -> tuple[Figure, Axes]:
    """Axes in easting and northing, or longitude and latitude, true to scale, with a scale bar.

    There is room for a title above, for a bar of colours to the right, and for ``below_in`` inches of more below.
    """
    angular = crs is not None and is_geographic(crs)
    aspect = 1.0 / max(math.cos(math.radians(0.5 * (extent[2] + extent[3]))), 0.01) if angular else 1.0
    centre = 0.5 * (extent[0] + extent[1]), 0.5 * (extent[2] + extent[3])
    width, height = extent[1] - extent[0], extent[3] - extent[2]
    width = max(width, height * aspect / _TALLEST)
    height = max(height, width / aspect * _FLATTEST)
    # As large as a map may be.
    map_in = min(_MAP_IN[0], _MAP_IN[1] * width / (height * aspect))
    map_size = map_in, map_in * height * aspect / width
    left, right, below, above = _MARGINS_IN
    size = map_size[0] + left + right, map_size[1] + below + above + below_in
    figure = Figure(figsize=size)
    FigureCanvasAgg(figure)
    place = (left / size[0], (below + below_in) / size[1], map_size[0] / size[0], map_size[1] / size[1])
    axes = plain(figure.add_axes(place))
    axes.set_facecolor(EMPTY)
    axes.set_aspect(aspect, adjustable="box")
    axes.set_xlim(centre[0] - 0.5 * width, centre[0] + 0.5 * width)
    axes.set_ylim(centre[1] - 0.5 * height, centre[1] + 0.5 * height)
    unit = "m" if crs is None else unit_sign(crs, 0)
    axes.set_xlabel(f"{'longitude' if angular else 'easting'} [{unit}]")
    axes.set_ylabel(f"{'latitude' if angular else 'northing'} [{unit}]")
    for axis, count in ((axes.xaxis, 4), (axes.yaxis, 7)):
        axis.set_major_locator(MaxNLocator(count, steps=[1, 2, 5, 10]))
        formatter = ScalarFormatter(useOffset=False)
        formatter.set_scientific(False)
        axis.set_major_formatter(formatter)
    unit_m = crs.axis_info[0].unit_conversion_factor if crs is not None else 1.0
    _scale_bar(axes, unit_m * EARTH_RADIUS_M / aspect if angular else unit_m)
    return figure, axes


def unit_sign(crs: CRS, axis: int) -> str:
    """The sign of the unit of an axis, or its name where it has none."""
    unit = crs.axis_info[axis].unit_name
    return {"metre": "m", "degree": "°"}.get(unit, unit)


def plain(axes: Axes) -> Axes:
    """Axes in the colours of the report, with two of their four sides."""
    axes.tick_params(colors=SOFT, labelsize=_TICK_PT)
    axes.xaxis.label.set_color(INK)
    axes.yaxis.label.set_color(INK)
    axes.spines[["top", "right"]].set_visible(False)
    axes.spines[["left", "bottom"]].set_color(SOFT)
    return axes


def _scale_bar(axes: Axes, metres_per_unit: float) -> None:
    """A bar of a round number of metres, about a sixth of the width, and grid north, below the map to the right."""
    west, east = axes.get_xlim()
    width_m = (east - west) * metres_per_unit
    power = 10.0 ** math.floor(math.log10(width_m / 6.0))
    length_m = max(step * power for step in (1.0, 2.0, 5.0) if step * power <= width_m / 6.0)
    start, end, inch = 0.94 - length_m / width_m, 0.94, axes.figure.dpi / axes.bbox.height
    words: dict[str, Any] = {"transform": axes.transAxes, "va": "center", "color": INK, "fontsize": 9}
    bar: dict[str, Any] = {"solid_capstyle": "butt", "clip_on": False, "transform": axes.transAxes}
    axes.plot([start, end], [-0.45 * inch] * 2, color=INK, lw=3, **bar)
    axes.text(start - 0.015, -0.45 * inch, f"{length_m:g} m", ha="right", **words)
    axes.text(0.985, -0.45 * inch, "↑\nN", ha="center", linespacing=0.9, weight="bold", **words)


def write_labels(axes: Axes, places: np.ndarray, texts: Sequence[str]) -> None:
    """Texts beside places (N, 2), each in the first corner where it covers no place and no other; none where all do."""
    lay_out(figure_of(axes))
    size = _POINT_PT * figure_of(axes).dpi / 72.0
    taken = [Bbox.from_bounds(x - size / 2, y - size / 2, size, size) for x, y in axes.transData.transform(places)]
    for text, place in zip(texts, places, strict=True):
        for across, up in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
            label = axes.annotate(
                figure_text(text), place, (5 * across, 5 * up), textcoords="offset points", fontsize=7.5, color=INK,
                ha="left" if across > 0 else "right", va="bottom" if up > 0 else "top", zorder=6,
            )  # fmt: skip
            box = label.get_window_extent()
            if not any(box.overlaps(other) for other in taken):
                taken.append(box)
                break
            label.remove()


def write_title(axes: Axes, title: str, subtitle: str = "") -> None:
    """A title, and a smaller line below it."""
    axes.set_title(figure_text(title), loc="left", color=INK, fontsize=12, pad=22 if subtitle else 10, weight="bold")
    if subtitle:
        axes.text(0.0, 1.0, subtitle, transform=axes.transAxes, va="bottom", color=SOFT, fontsize=9.5)


def figure_of(axes: Axes) -> Figure:
    """The whole figure that axes are a part of."""
    figure = axes.figure
    if not isinstance(figure, Figure):
        raise TypeError(f"axes of {type(figure).__name__} are not part of a figure of their own")
    return figure


def lay_out(figure: Figure) -> None:
    """Place what a figure has so far as `save` will; nothing where places are given."""
    figure.set_dpi(_DPI)
    engine = figure.get_layout_engine()
    if engine is not None:
        engine.execute(figure)


def save(figure: Figure, path: Path) -> None:
    """Write a PNG, whole or not at all; raises UnwritableFile."""
    lay_out(figure)
    # Matplotlib would lay it out again, and draw it for that.
    figure.set_layout_engine("none")
    buffer = io.BytesIO()
    # A tenth larger than by default, in two thirds of the time.
    figure.savefig(buffer, format="png", dpi=_DPI, pil_kwargs={"compress_level": _COMPRESSION})
    with write_whole(path) as stream:
        stream.write(buffer.getvalue())


@dataclass(frozen=True)
class Picture:
    """A picture of a report: its file, and the words about it."""

    path: Path
    title: str
    caption: str


def finished(axes: Axes, path: Path, title: str, subtitle: str, caption: str) -> Picture:
    """Write a title over axes and their figure as PNG; raises UnwritableFile."""
    write_title(axes, title, subtitle)
    save(figure_of(axes), path)
    return Picture(path, title, caption)
