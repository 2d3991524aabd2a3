"""Colours of depth, height and dry ground, shaded by relief, and the bar that explains them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colorbar import Colorbar
from matplotlib.colors import Colormap, LightSource, LinearSegmentedColormap, Normalize

from survey.compare.canvas import INK, SOFT
from survey.report.raster import PlanGrid, hillshade

# Light and yellowish where shallow, dark blue where deep; lightness falls steadily.
DEPTH = LinearSegmentedColormap.from_list(
    "depth", ["#fbf9cf", "#c6e6a8", "#7fcaa5", "#48a9a8", "#3a86a8", "#41649d", "#484884", "#3c2d5e"]
)
HEIGHT = LinearSegmentedColormap.from_list("height", ["#3f5d54", "#7d9a6b", "#c9c58b", "#d9b07a", "#b4795c", "#f1e8e2"])
DRY = LinearSegmentedColormap.from_list("dry", ["#77746e", "#c8c4bb"])

_BAR_WIDTH_IN = 0.2


@dataclass(frozen=True)
class Picture:
    """A picture of a report: its file, and the words about it."""

    path: Path
    title: str
    caption: str


def shaded_bed(depth: np.ndarray | None, height: np.ndarray, cell_m: float) -> tuple[np.ndarray, ScalarMappable]:
    """A bed as an image (rows, columns, 4), transparent where unknown, and the scale of its colours.

    Parameters
    ----------
    depth : (rows, columns) [m] or None
        Below the water; NaN on dry ground, which is drawn in greys. None for a dry survey, which is coloured
        by height.
    height : (rows, columns) [m]
        NaN where unknown.
    cell_m : [m]
        Between neighbouring cells, for the relief.
    """
    shade = hillshade(height, cell_m)
    if depth is None:
        return _coloured(height, shade, HEIGHT)
    is_wet = np.isfinite(depth)
    image, scale = _coloured(depth, shade, DEPTH)
    dry, _ = _coloured(np.where(is_wet, np.nan, height), shade, DRY)
    return np.where(is_wet[..., None], image, dry), scale


def _coloured(values: np.ndarray, shade: np.ndarray, colours: Colormap) -> tuple[np.ndarray, ScalarMappable]:
    """Values (rows, columns) as an image (rows, columns, 4); the scale spans their inner 98 %."""
    known = np.isfinite(values)
    low, high = np.quantile(values[known], [0.01, 0.99]) if known.any() else (0.0, 1.0)
    scale = ScalarMappable(Normalize(low, high if high > low else low + 1e-3), colours)
    rgb = colours(scale.norm(np.where(known, values, low)))[..., :3]
    image = np.clip(LightSource().blend_soft_light(rgb, shade[..., None]), 0.0, 1.0)
    return np.concatenate([image, known[..., None]], axis=-1), scale


def show(axes: Axes, image: np.ndarray, grid: PlanGrid) -> None:
    """Draw an image (rows, columns, 4) of a grid into axes in crs, whose limits stay as they are."""
    across, along = axes.get_xlim(), axes.get_ylim()
    axes.imshow(image, extent=grid.extent, aspect=axes.get_aspect(), interpolation="nearest", zorder=1)
    axes.set(xlim=across, ylim=along)


def colour_bar(axes: Axes, scale: ScalarMappable, label: str, *, is_depth: bool = False, extend="both"):
    """A bar beside axes that explains their colours; depths grow downwards."""
    figure = axes.figure
    beside = axes.inset_axes([1.025, 0.06, _BAR_WIDTH_IN / (axes.bbox.width / figure.dpi), 0.88])
    bar: Colorbar = figure.colorbar(scale, cax=beside, extend=extend)
    bar.set_label(label, color=INK)
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=SOFT, labelsize=8.5)
    if is_depth:
        bar.ax.invert_yaxis()
    return bar
