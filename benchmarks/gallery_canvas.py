"""Plots of the gallery: colours, vertical sections, words beside lines. Used by draw_gallery.py."""

import io
import math
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from PIL import Image

from refract import FlatWater, PinholeCamera
from survey.display.palette import INK, SOFT

# Okabe and Ito's colours, distinguishable with colour blindness; on white, with pale water.
BLUE, ORANGE, GREEN, RED = "#0072b2", "#e69f00", "#009e73", "#d55e00"
DARK_ORANGE, IN_WATER, BED, GRID = "#a86f00", "#e3f0f7", "#8a6f4e", "#e6e9ec"


def canvas(width: float, height: float, **layout) -> tuple[Figure, np.ndarray]:
    """A figure [inch] of one or more plots, drawn without a display."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    plots = figure.subplots(squeeze=False, **layout)
    for axes in plots.flat:
        axes.tick_params(colors=SOFT, labelsize=8.5)
        axes.spines[["right", "top"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(SOFT)
    return figure, plots


def label(axes: Axes, title: str, x: str, y: str) -> None:
    axes.set_title(title, loc="left", color=INK, fontsize=10)
    axes.set_xlabel(x, color=INK, fontsize=9)
    axes.set_ylabel(y, color=INK, fontsize=9)


def section(axes: Axes, low: float, high: float, bottom: float, top: float) -> None:
    """A vertical section, as high as wide to scale, with water under z = 0."""
    axes.axhspan(bottom, 0.0, color=IN_WATER, lw=0, zorder=0)
    axes.axhline(0.0, color=BLUE, lw=1.2, zorder=1)
    axes.set(xlim=(low, high), ylim=(bottom, top), aspect="equal")


def line(axes: Axes, *points, **style) -> None:
    """A chain of straight legs through points (3,), seen from the south."""
    chain = np.array(points)
    axes.plot(chain[:, 0], chain[:, 2], **style)


def note(axes: Axes, text: str, at: tuple[float, float], to: tuple[float, float] | None = None, **style) -> None:
    """Words at a place, with a thin line to what they mean."""
    style = {"color": INK, "fontsize": 8.5} | style
    arrow = {"arrowstyle": "-", "color": style["color"], "lw": 0.7, "shrinkA": 1, "shrinkB": 2}
    axes.annotate(text, to or at, xytext=at, arrowprops=arrow if to else None, **style)


def px_per_m(camera: PinholeCamera, water: FlatWater | None, pixel: tuple[float, float], height: float) -> float:
    """Pixels along a row of a picture that a metre covers, on a level plane at a height [m] over that of the water."""
    u, v = pixel
    beside = [[u - 0.5, v], [u + 0.5, v]]
    left, right = camera.paths(beside, water).at_height(np.full(2, height), water)
    return float(1.0 / np.linalg.norm(right - left))


def bar_length(width_m: float) -> float:
    """Length [m] of a scale bar for a picture of a width [m]: 1, 2 or 5 of a decade, a quarter of the width at most."""
    decade = 10.0 ** math.floor(math.log10(0.25 * width_m))
    return max(decade * each for each in (1.0, 2.0, 5.0) if decade * each <= 0.25 * width_m * (1.0 + 1e-9))


def scale_bar(axes: Axes, scale: float) -> None:
    """A bar with its length below left in a picture, of so many pixels to the metre."""
    (x0, x1), (y0, y1) = axes.get_xlim(), axes.get_ylim()
    length, wide, high = bar_length(abs(x1 - x0) / scale), x1 - x0, y1 - y0
    x, y, edge = x0 + 0.04 * wide, y0 + 0.06 * high, [withStroke(linewidth=2.5, foreground=INK)]
    axes.plot([x, x + length * scale], [y, y], color="white", lw=2.0, solid_capstyle="butt", path_effects=edge)
    axes.set(xlim=(x0, x1), ylim=(y0, y1))
    said = f"{length:g} m" if length >= 1.0 else f"{100.0 * length:g} cm"
    axes.text(
        x + 0.5 * length * scale, y + 0.02 * high, said, color="white", ha="center", va="bottom", fontsize=8.5,
        path_effects=edge,
    )  # fmt: skip


def save(figure: Figure, path: Path) -> None:
    """Write a PNG of 256 colours, a third of the size of one of all colours."""
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=140, format="png")
    Image.open(buffer).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)
