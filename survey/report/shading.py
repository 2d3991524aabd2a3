"""Shaded relief of a bed, coloured by depth or height."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, LightSource, Normalize

from survey.display.palette import DEPTHS, DRY_GROUND, HEIGHTS
from survey.report.raster import hillshade


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
        return _coloured(height, shade, HEIGHTS)
    is_wet = np.isfinite(depth)
    image, scale = _coloured(depth, shade, DEPTHS)
    dry, _ = _coloured(np.where(is_wet, np.nan, height), shade, DRY_GROUND)
    return np.where(is_wet[..., None], image, dry), scale


def _coloured(values: np.ndarray, shade: np.ndarray, colours: Colormap) -> tuple[np.ndarray, ScalarMappable]:
    """Values (rows, columns) as an image (rows, columns, 4); the scale spans their inner 98 %."""
    known = np.isfinite(values)
    low, high = np.quantile(values[known], [0.01, 0.99]) if known.any() else (0.0, 1.0)
    scale = ScalarMappable(Normalize(low, high if high > low else low + 1e-3), colours)
    rgb = np.asarray(colours(scale.norm(np.where(known, values, low))))[..., :3]
    image = np.clip(LightSource().blend_soft_light(rgb, shade[..., None]), 0.0, 1.0)
    return np.concatenate([image, known[..., None]], axis=-1), scale
