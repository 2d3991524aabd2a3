"""The bed as a raster of heights, with the attributes of each cell.

Gaps are filled up to a stated width: where a square of that width does not fit into them. Filled cells are marked in a
mask. Their height is the mean of the known cells around, weighted by the inverse square of the distance; its standard
deviation is that distance times the root mean square slope of the known cells near by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pyproj import CRS
from scipy import ndimage
from scipy.spatial import cKDTree

from geo.crs import height_unit_m
from geo.grid import Grid, Window
from survey.display.quantities import round_up
from survey.errors import SurveyError

# Largest raster: more cells result from a mistaken resolution, or from stray points far away.
_MOST_CELLS = 4_000_000_000
# Steps of resolutions that are chosen, times a power of ten.
_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)
# Points for the fit of the level: a plane of the local frame is curved in crs by Earth and map projection.
_MOST_POINTS = 20_000
_TILE = 512
# Known cells from which a gap cell is interpolated.
_NEIGHBOURS = 12
# Slope to assume where none is known [-].
_ANY_SLOPE = 1.0
# Origins of a height: the points of the cell, or interpolation between cells.
POINTS, FILLED = 1, 2


def cells_over(points_crs: np.ndarray, crs: CRS, side_m: float) -> Grid:
    """Aligned cells of a side [m] that cover points (N, 2 or more)."""
    grid = Grid.southward_aligned(points_crs, crs, side_m)
    rows, columns = grid.shape
    if rows * columns > _MOST_CELLS:
        raise SurveyError(
            f"a raster of {columns} x {rows} cells of {side_m:g} m is too large; give a larger --resolution, or "
            "[area] bounds without the strays that lie far off"
        )
    return grid


def round_side(side_m: float) -> float:
    """The next larger round length: 0.083 becomes 0.1."""
    return round_up(side_m, _ROUND)


@dataclass(frozen=True)
class BedRaster:
    """The bed as a raster; arrays (rows, columns), in files."""

    cells: Grid
    # float32 [m]: mean height of the bed over the cell, seen from above; undefined where `origin` is 0
    height: np.ndarray
    std: np.ndarray  # float32 [m]: standard deviation of that height by the errors of the cell
    # float32 [m]: standard deviation common to all heights, by water, lens and poses, where the run knows it
    common: np.ndarray
    count: np.ndarray  # uint32: points that the height is from; 0 where it was filled
    origin: np.ndarray  # uint8, of the height: `POINTS`, `FILLED`, or 0 where there is none
    incidence: np.ndarray  # float32 [rad]: mean angle in air at which its points were seen
    level: LevelFit | None  # Height of the water; None for a dry survey
    pixel_m: float  # [m]: what a pixel of the photographs covers

    def heights(self, window: Window) -> np.ndarray:
        """Heights (rows, columns) float64 [m] of a window, NaN where there is none."""
        at = window.slices
        return np.where(self.origin[at] > 0, self.height[at].astype(np.float64), np.nan)

    def stds(self, window: Window) -> np.ndarray:
        """Standard deviations (rows, columns) float64 [m] by all errors, NaN where there is no height."""
        at = window.slices
        return np.where(self.origin[at] > 0, np.hypot(self.std[at].astype(np.float64), self.common[at]), np.nan)

    def depths(self, window: Window) -> np.ndarray:
        """Depth under the water (rows, columns) float64 [m], negative above it; NaN without height or water."""
        if self.level is None:
            return np.full(window.shape, np.nan)
        return self.level(self.cells.middles(window)) - self.heights(window)

    @property
    def height_unit_m(self) -> float:
        """The unit of heights in crs [m]."""
        return height_unit_m(self.cells.crs)


@dataclass(frozen=True)
class LevelFit:
    """Quadratic function of plan, fitted to the water level over the points of a cloud."""

    # middle, extent: (2,) in crs: mean of the points, and their extent along each axis
    middle: np.ndarray
    extent: np.ndarray
    coefficients: np.ndarray  # (6,) [m]: of 1, x, y, x x, x y, y y, with x and y from the middle in extents

    @staticmethod
    def of(points: np.ndarray, depth: np.ndarray) -> LevelFit | None:
        """Fit to the level over points (N, 3), heights in metres, of depths (N,) [m]; None without depths."""
        known = np.flatnonzero(np.isfinite(depth))
        if not len(known):
            return None
        some = known[:: len(known) // _MOST_POINTS + 1]
        plan, level = points[some, :2], points[some, 2] + depth[some]
        middle, extent = plan.mean(axis=0), np.maximum(np.ptp(plan, axis=0), 1e-9)
        base = float(level.mean())
        coefficients, *_ = np.linalg.lstsq(_terms((plan - middle) / extent), level - base, rcond=1e-9)
        coefficients[0] += base
        return LevelFit(middle, extent, coefficients)

    def __call__(self, plan: np.ndarray) -> np.ndarray:
        """Height of the water [m] (...) at places (..., 2) in crs."""
        return _terms((plan - self.middle) / self.extent) @ self.coefficients


def _terms(plan: np.ndarray) -> np.ndarray:
    """Monomials (..., 6) up to the second degree of places (..., 2)."""
    x, y = plan[..., 0], plan[..., 1]
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)


def fill_gaps(grid: BedRaster, width_m: float) -> None:
    """Fill the gaps of a raster up to a width [m], in place."""
    cells = grid.cells
    width = int(width_m / cells.side_m + 1e-6)
    if width < 1:
        return
    found = []
    for window in cells.windows(_TILE):
        around = window.grown(2 * width + 2, cells.shape)
        known = grid.origin[around.slices] == POINTS
        closed = _closed(known, width)
        inner = np.zeros_like(known)
        inner[window.within(around)] = True
        gaps = np.argwhere(closed & ~known & inner)
        if len(gaps):
            corner = np.array([around.top, around.left])
            found.append((tuple((gaps + corner).T), _interpolated(grid, known, around, gaps)))
    # All are interpolated from measured cells before any is set.
    for place, values in found:
        grid.height[place], grid.std[place], grid.common[place], grid.incidence[place] = values
        grid.origin[place] = FILLED


def _closed(known: np.ndarray, width: int) -> np.ndarray:
    """Morphological closing: known cells, and those in whose gap no square of more than ``width`` cells fits."""
    # Beyond the raster nothing is known, so that gaps continue there.
    gap = np.pad(~known, width + 1, constant_values=True)
    # Separable, so that wide gaps cost no more than narrow ones.
    opened = ndimage.grey_opening(gap.astype(np.uint8), size=width + 1, mode="constant", cval=0)
    return (opened == 0)[width + 1 : -width - 1, width + 1 : -width - 1]


def _interpolated(grid: BedRaster, known: np.ndarray, around: Window, gaps: np.ndarray) -> np.ndarray:
    """Height, both standard deviations [m] and incidence [rad] (4, K) of cells (K, 2), by inverse-distance weights."""
    layers = (grid.height, grid.std, grid.common, grid.incidence)
    height, std, common, incidence = (layer[around.slices].astype(np.float64) for layer in layers)
    places = np.argwhere(known)
    count = min(_NEIGHBOURS, len(places))
    distance, near = cKDTree(places).query(gaps, k=count)
    distance, near = distance.reshape(len(gaps), count), near.reshape(len(gaps), count)
    weight = 1.0 / distance**2
    weight /= weight.sum(axis=1, keepdims=True)
    of = tuple(places[near].transpose(2, 0, 1))
    # By the root mean square slope between neighbouring known cells.
    shown = np.where(known, height, np.nan)
    steps = np.concatenate([np.diff(shown, axis=axis).ravel() for axis in (0, 1)]) / grid.cells.side_m
    steps = steps[np.isfinite(steps)]
    slope = float(np.sqrt(2.0 * np.square(steps).mean())) if len(steps) else _ANY_SLOPE
    step = distance[:, 0] * grid.cells.side_m * slope

    def mean(values: np.ndarray) -> np.ndarray:
        return (weight * values[of]).sum(axis=1)

    return np.stack([mean(height), np.sqrt(mean(std**2) + step**2), np.sqrt(mean(common**2)), mean(incidence)])
