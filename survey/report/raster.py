"""Points seen from above: binned into cells, shaded by relief, for the pictures of a report."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from pyproj import CRS
from scipy import ndimage

from geo.crs import horizontal_unit, is_geographic

_EARTH_RADIUS_M = 6.371e6
# A few stray points must not shrink the picture of all others.
_STRAY_SHARE = 0.001
_MARGIN = 0.05
# Points that tell the extent of all.
_ENOUGH = 200_000
# So that the outermost point, on the edge of the last cell, does not need a further one.
_A_LITTLE_MORE = 1.0 + 1e-6
# So that a hole in the picture is a hole in the cloud, and not one by chance.
_POINTS_PER_CELL = 3.0


@dataclass(frozen=True)
class PlanGrid:
    """Square cells in plan; rows run from north to south.

    Attributes
    ----------
    west, north : in crs
        Outer corner of the first cell.
    cell : (east, north), in units of crs
    cell_m : [m]
    shape : (rows, columns)
    index : (N,) int64
        Cell of each point, row by row; -1 for strays beyond the grid.
    """

    west: float
    north: float
    cell: tuple[float, float]
    cell_m: float
    shape: tuple[int, int]
    index: np.ndarray

    @staticmethod
    def over(points_crs: np.ndarray, crs: CRS, *, cell_m: float, max_cells: int) -> PlanGrid:
        """The grid over points (N, 3) in crs, N at least 1, with cells of ``cell_m`` [m].

        Cells are made larger where there would be more than ``max_cells`` along a side, or fewer than three
        points in each on average. Points that lie beyond the outermost 0.1 % by more than a twentieth of the
        extent are strays.
        """
        plan = points_crs[:, :2]
        unit = metres_per_unit(crs, float(plan[0, 1]))
        some = plan[:: len(plan) // _ENOUGH + 1]
        low, high = np.quantile(some, [_STRAY_SHARE, 1.0 - _STRAY_SHARE], axis=0)
        margin = _MARGIN * (high - low)
        low, high = np.maximum(low - margin, plan.min(axis=0)), np.minimum(high + margin, plan.max(axis=0))
        side_m = (high - low) * unit
        sparse_m = math.sqrt(_POINTS_PER_CELL * float(side_m.prod()) / len(plan))
        cell_m = max(cell_m, _A_LITTLE_MORE * float(side_m.max()) / max_cells, sparse_m, 1e-6)
        columns, rows = (math.floor(side / cell_m) + 1 for side in side_m)
        cell = cell_m / unit
        column, row = (
            np.floor((plan[:, 0] - low[0]) / cell[0]).astype(np.int64),
            np.floor((high[1] - plan[:, 1]) / cell[1]).astype(np.int64),
        )
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        index = np.where(inside, row * columns + column, -1)
        corner = (float(low[0]), float(high[1]))
        return PlanGrid(*corner, (float(cell[0]), float(cell[1])), cell_m, (rows, columns), index)

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north of the outer edges, in crs, as matplotlib takes them."""
        rows, columns = self.shape
        return (
            self.west,
            self.west + columns * self.cell[0],
            self.north - rows * self.cell[1],
            self.north,
        )

    @property
    def aspect(self) -> float:
        """Height of a unit of northing over the width of a unit of easting, for a picture true to scale."""
        return self.cell[0] / self.cell[1]

    def count(self, among: np.ndarray | None = None) -> np.ndarray:
        """Points in each cell, of those ``among`` (N,) bool."""
        index = self.index[among] if among is not None else self.index
        index = index[index >= 0]
        return np.bincount(index, minlength=self.shape[0] * self.shape[1]).reshape(self.shape)

    def mean(self, values: np.ndarray, among: np.ndarray | None = None) -> np.ndarray:
        """Mean of values (N,) in each cell, NaN where there is none; values that are NaN do not count."""
        use = (self.index >= 0) & np.isfinite(values)
        if among is not None:
            use &= among
        size = self.shape[0] * self.shape[1]
        number = np.bincount(self.index[use], minlength=size)
        total = np.bincount(self.index[use], weights=values[use].astype(np.float64), minlength=size)
        empty = number == 0
        return np.where(empty, np.nan, total / np.maximum(number, 1)).reshape(self.shape)

    def highest(self, height: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Values (N, ...) of the highest point of each cell, (rows, columns, ...) float64; NaN where none."""
        order = np.argsort(height, kind="stable")
        order = order[self.index[order] >= 0]
        top = np.full((self.shape[0] * self.shape[1], *values.shape[1:]), np.nan)
        # Of points in one cell the last one assigned stays.
        top[self.index[order]] = values[order]
        return top.reshape(*self.shape, *values.shape[1:])


def metres_per_unit(crs: CRS, north: float) -> np.ndarray:
    """Metres of one unit of easting and of northing (2,), at a northing or latitude, to 1 %."""
    unit = horizontal_unit(crs)
    if not is_geographic(crs):
        return np.array([unit, unit])
    along = unit * _EARTH_RADIUS_M
    return np.array([along * math.cos(north * unit), along])


def without_pinholes(raster: np.ndarray) -> np.ndarray:
    """A raster (rows, columns, ...) whose single empty cells have the mean of their neighbours.

    A cell is single where at least five of the eight cells around it are filled; larger gaps stay.
    """
    empty = np.isnan(raster.reshape(*raster.shape[:2], -1)).any(axis=-1)
    around = np.ones((3, 3))
    filled = ndimage.convolve((~empty).astype(np.float64), around, mode="constant")
    single = empty & (filled >= 5.0)
    if not single.any():
        return raster
    layers = np.where(empty[..., None], 0.0, raster.reshape(*raster.shape[:2], -1))
    result = raster.reshape(*raster.shape[:2], -1).copy()
    for number in range(layers.shape[-1]):
        total = ndimage.convolve(layers[..., number], around, mode="constant")
        result[single, number] = total[single] / filled[single]
    return result.reshape(raster.shape)


def hillshade(height: np.ndarray, cell_m: float) -> np.ndarray:
    """Light on a relief (rows, columns) [m] from the north-west, 0 to 1; 0.5 where level or unknown.

    The relief is exaggerated so that its steeper parts stand at about 45 degrees: it shows form, not slope.
    """
    known = np.isfinite(height)
    if min(height.shape) < 2:
        return np.full(height.shape, 0.5)
    weight = ndimage.gaussian_filter(known.astype(np.float64), 1.0)
    smooth = ndimage.gaussian_filter(np.where(known, height, 0.0), 1.0) / np.maximum(weight, 1e-9)
    south, east = np.gradient(smooth, cell_m)
    # Beyond the edge of what is known, the ratio above says nothing.
    inner = known & (weight > 0.6)
    slope = np.hypot(south, east)
    steep = float(np.quantile(slope[inner], 0.9)) if inner.any() else 0.0
    exaggeration = min(1.0 / steep, 20.0) if steep > 1e-9 else 1.0
    length = np.sqrt(1.0 + (exaggeration * slope) ** 2)
    # Light from the north-west at 45 degrees: east -1/2, north 1/2, up 1/sqrt(2).
    light = (0.5 * exaggeration * east + 0.5 * exaggeration * south + math.sqrt(0.5)) / length
    return np.where(inner, np.clip(0.5 + 0.6 * (light - math.sqrt(0.5)), 0.0, 1.0), 0.5)
