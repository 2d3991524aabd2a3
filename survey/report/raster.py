"""Rasters prepared for display: single holes closed, relief shaded and coloured by depth or height."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LightSource, Normalize
from scipy import ndimage

from survey.compare.canvas import figure_of, save, write_title
from survey.display.palette import DEPTHS, DRY_GROUND, HEIGHTS

# Rows of an image whose colours are worked out at a time.
_ROWS = 64


def without_pinholes(raster: np.ndarray) -> np.ndarray:
    """A raster (rows, columns, ...) whose single empty cells have the mean of their neighbours.

    A cell is single where at least five of the eight cells around it are filled; larger gaps stay.
    """
    layers = raster.reshape(*raster.shape[:2], -1)
    empty = np.isnan(layers).any(axis=-1)
    around = np.ones((3, 3), dtype=np.float32)
    filled = ndimage.convolve((~empty).astype(np.float32), around, mode="constant")
    rows, columns = np.nonzero(empty & (filled >= 5.0))
    total = np.zeros((len(rows), layers.shape[-1]))
    for down, across in product((-1, 0, 1), repeat=2):
        # Beyond the raster the cell itself, which is empty.
        row, column = rows + down, columns + across
        beyond = (row < 0) | (row >= len(empty)) | (column < 0) | (column >= empty.shape[1])
        row, column = np.where(beyond, rows, row), np.where(beyond, columns, column)
        total += np.where(empty[row, column][:, None], 0.0, layers[row, column])
    result = layers.copy()
    result[rows, columns] = total / filled[rows, columns][:, None]
    return result.reshape(raster.shape)


def hillshade(height: np.ndarray, cell_m: float) -> np.ndarray:
    """Light on a relief (rows, columns) [m] from the north-west, float32, 0 to 1; 0.5 where level or unknown.

    The relief is exaggerated so that its steeper parts stand at about 45 degrees: it shows form, not slope.
    """
    known = np.isfinite(height)
    if min(height.shape) < 2 or not known.any():
        return np.full(height.shape, 0.5, dtype=np.float32)
    weight = ndimage.gaussian_filter(known.astype(np.float32), 1.0)
    # About their mean, heights have all digits in single precision.
    relief = np.where(known, height - height[known].mean(), 0.0).astype(np.float32)
    smooth = ndimage.gaussian_filter(relief, 1.0) / np.maximum(weight, 1e-9)
    south, east = np.gradient(smooth, cell_m)
    # Beyond the edge of what is known, the ratio above is meaningless.
    inner = known & (weight > 0.6)
    slope = np.hypot(south, east)
    steep = float(np.quantile(slope[inner], 0.9)) if inner.any() else 0.0
    exaggeration = min(1.0 / steep, 20.0) if steep > 1e-9 else 1.0
    length = np.sqrt(1.0 + (exaggeration * slope) ** 2)
    # Light from the north-west at 45 degrees: east -1/2, north 1/2, up 1/sqrt(2).
    light = (0.5 * exaggeration * (east + south) + math.sqrt(0.5)) / length
    return np.where(inner, np.clip(0.5 + 0.6 * (light - math.sqrt(0.5)), 0.0, 1.0), np.float32(0.5))


def image_of(values: np.ndarray, scale: ScalarMappable) -> np.ndarray:
    """Values (rows, columns) in the colours of a scale (rows, columns, 4) uint8, transparent where NaN."""
    image = np.empty((*values.shape, 4), dtype=np.uint8)
    # Colours of a value take 100 bytes while they are worked out.
    for first in range(0, len(values), _ROWS):
        rows = slice(first, first + _ROWS)
        image[rows] = scale.to_rgba(np.ma.masked_invalid(values[rows]), bytes=True)
    return image


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


def shaded_bed(depth: np.ndarray | None, height: np.ndarray, cell_m: float) -> tuple[np.ndarray, ScalarMappable]:
    """A bed as an image (rows, columns, 4) uint8, transparent where unknown, and the scale of its colours.

    Depths (rows, columns) [m] below the water are NaN on dry ground, which is drawn in greys; None is a dry survey,
    coloured by height [m]. Cells are `cell_m` [m] apart, for the relief.
    """
    shade = hillshade(height, cell_m)
    if depth is None:
        return _coloured(height, shade, HEIGHTS)
    is_wet = np.isfinite(depth)
    image, scale = _coloured(depth, shade, DEPTHS)
    dry, _ = _coloured(np.where(is_wet, np.nan, height), shade, DRY_GROUND)
    return np.where(is_wet[..., None], image, dry), scale


def _coloured(values: np.ndarray, shade: np.ndarray, colours: Colormap) -> tuple[np.ndarray, ScalarMappable]:
    """Values (rows, columns) as an image (rows, columns, 4) uint8; the scale spans their inner 98 %."""
    known = np.isfinite(values)
    low, high = np.quantile(values[known], [0.01, 0.99]) if known.any() else (0.0, 1.0)
    scale = ScalarMappable(Normalize(low, high if high > low else low + 1e-3), colours)
    image = np.zeros((*values.shape, 4), dtype=np.uint8)
    # Colours in float64 take 200 bytes a cell.
    for first in range(0, len(values), _ROWS):
        rows = slice(first, first + _ROWS)
        rgb = np.asarray(colours(scale.norm(np.where(known[rows], values[rows], low))))[..., :3]
        lit = np.clip(LightSource().blend_soft_light(rgb, shade[rows, :, None]), 0.0, 1.0)
        image[rows, :, :3], image[rows, :, 3] = np.rint(255.0 * lit), np.where(known[rows], 255, 0)
    return image, scale
