"""Gap filling of a raster up to a width, with a mask and a standard deviation of filled cells.

A gap is filled where a square of the stated width does not fit into it. The height is the mean of the known cells
around, weighted by the inverse square of their distance; it is as uncertain as the bed changes over that distance: by
the root mean square slope of the known cells near by.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from survey.export.bed_cells import Gridded
from survey.export.plan_cells import Window

_TILE = 512
# Known cells that a filled one is made of.
_NEIGHBOURS = 12
# Where nothing is known of the slope [-].
_ANY_SLOPE = 1.0


def fill_gaps(grid: Gridded, width_m: float) -> None:
    """Fill the gaps of a raster that are at most so wide [m], in place."""
    cells = grid.cells
    width = int(width_m / cells.side_m + 1e-6)
    if width < 1:
        return
    found = []
    for window in cells.windows(_TILE):
        around = window.grown(2 * width + 2, cells.shape)
        known = grid.known[around.slices] == 1
        closed = _closed(known, width)
        inner = np.zeros_like(known)
        inner[window.within(around)] = True
        gaps = np.argwhere(closed & ~known & inner)
        if len(gaps):
            corner = np.array([around.top, around.left])
            found.append((tuple((gaps + corner).T), _interpolated(grid, known, around, gaps)))
    # All of them are made from points before any is set.
    for place, values in found:
        grid.height[place], grid.std[place], grid.common[place], grid.incidence[place] = values
        grid.known[place] = 2


def _closed(known: np.ndarray, width: int) -> np.ndarray:
    """Known cells, and those in whose gap no square of more than ``width`` cells fits."""
    # Beyond the raster nothing is known: the gap goes on there.
    gap = np.pad(~known, width + 1, constant_values=True)
    # Along one axis after the other, so that wide gaps cost no more than narrow ones.
    opened = ndimage.grey_opening(gap.astype(np.uint8), size=width + 1, mode="constant", cval=0)
    return (opened == 0)[width + 1 : -width - 1, width + 1 : -width - 1]


def _interpolated(grid: Gridded, known: np.ndarray, around: Window, gaps: np.ndarray) -> np.ndarray:
    """Height, both standard deviations [m] and incidence [rad] (4, K) of cells (K, 2) of a window, from known ones."""
    layers = (grid.height, grid.std, grid.common, grid.incidence)
    height, std, common, incidence = (layer[around.slices].astype(np.float64) for layer in layers)
    places = np.argwhere(known)
    count = min(_NEIGHBOURS, len(places))
    distance, near = cKDTree(places).query(gaps, k=count)
    distance, near = distance.reshape(len(gaps), count), near.reshape(len(gaps), count)
    weight = 1.0 / distance**2
    weight /= weight.sum(axis=1, keepdims=True)
    of = tuple(places[near].transpose(2, 0, 1))
    step = distance[:, 0] * grid.cells.side_m * _slope(np.where(known, height, np.nan), grid.cells.side_m)

    def mean(values: np.ndarray) -> np.ndarray:
        return (weight * values[of]).sum(axis=1)

    return np.stack([mean(height), np.sqrt(mean(std**2) + step**2), np.sqrt(mean(common**2)), mean(incidence)])


def _slope(height: np.ndarray, side: float) -> float:
    """Root mean square slope between neighbouring known cells [-]."""
    steps = np.concatenate([np.diff(height, axis=0).ravel(), np.diff(height, axis=1).ravel()]) / side
    steps = steps[np.isfinite(steps)]
    return float(np.sqrt(2.0 * np.square(steps).mean())) if len(steps) else _ANY_SLOPE
