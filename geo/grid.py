"""Cells of a raster in plan: where they lie, and which of them holds a point."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from geo.projection import ground_units_m

# Tolerance [cells] for rounding of cell edges.
_ON_EDGE = 1e-6


@dataclass(frozen=True)
class Window:
    """Rows ``top`` to ``bottom`` and columns ``left`` to ``right`` of a raster, the later ones excluded."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def slices(self) -> tuple[slice, slice]:
        """Slices into an array (rows, columns, ...)."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    @property
    def shape(self) -> tuple[int, int]:
        return self.bottom - self.top, self.right - self.left

    def grown(self, cells: int, shape: tuple[int, int]) -> Window:
        """The window with a margin, as far as the raster has it."""
        return Window(
            max(self.top - cells, 0),
            min(self.bottom + cells, shape[0]),
            max(self.left - cells, 0),
            min(self.right + cells, shape[1]),
        )

    def within(self, larger: Window) -> tuple[slice, slice]:
        """Slices of this window in an array of a larger one."""
        moved = Window(
            self.top - larger.top, self.bottom - larger.top, self.left - larger.left, self.right - larger.left
        )
        return moved.slices


@dataclass(frozen=True)
class Grid:
    """Cells of one side on the ground, whatever the unit and the scale of the map (`geo.projection.ground_units_m`).

    The constructors say which way rows run.
    """

    map_crs: CRS | None  # None: places are in metres, of a local frame
    origin: tuple[float, float]  # (east, north), in crs: outer corner of the first cell
    # (east, north), in units of crs: to the next column, and to the next row, negative where rows run south
    step: tuple[float, float]
    side_m: float  # [m], on the ground
    shape: tuple[int, int]  # (rows, columns)

    @staticmethod
    def southward_aligned(points: np.ndarray, crs: CRS, side_m: float) -> Grid:
        """Cells of a side [m] that cover points (N, 2 or more), their edges at multiples of it; rows run south."""
        low, high = plan_box(points)
        side = side_m / ground_units_m(crs, 0.5 * (low + high))
        first, last = np.floor(low / side + _ON_EDGE), np.ceil(high / side - _ON_EDGE)
        columns, rows = (int(n) for n in np.maximum(last - first, 1))
        east, north = side.tolist()
        return Grid(crs, (float(first[0] * east), float(last[1] * north)), (east, -north), side_m, (rows, columns))

    @staticmethod
    def southward_from(low: np.ndarray, high: np.ndarray, side_m: float, crs: CRS | None = None) -> Grid:
        """Cells of a side [m] from the north-western corner of a box (2,), (2,) on; rows run south."""
        unit = np.ones(2) if crs is None else ground_units_m(crs, low)
        columns, rows = (math.floor(extent / side_m) + 1 for extent in (high - low) * unit)
        east, north = (side_m / unit).tolist()
        return Grid(crs, (float(low[0]), float(high[1])), (east, -north), side_m, (rows, columns))

    @staticmethod
    def northward_from(low: np.ndarray, side_m: float, shape: tuple[int, int]) -> Grid:
        """Cells of a side [m] from their south-western corner (2,) [m] on; rows run north."""
        return Grid(None, (float(low[0]), float(low[1])), (side_m, side_m), side_m, shape)

    @property
    def crs(self) -> CRS:
        """The CRS; raises ValueError for cells of a local frame."""
        if self.map_crs is None:
            raise ValueError("the cells are those of a local frame, expected some of a CRS")
        return self.map_crs

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Coefficients a to f of ``east = a column + b row + c, north = d column + e row + f``."""
        return (self.step[0], 0.0, self.origin[0], 0.0, self.step[1], self.origin[1])

    @property
    def box(self) -> np.ndarray:
        """Lowest and highest corner (2, 2), in crs."""
        ends = np.array([self.origin, self.origin + np.array(self.shape[::-1]) * self.step])
        return np.array([ends.min(axis=0), ends.max(axis=0)])

    @property
    def extent(self) -> tuple[float, float, float, float]:
        """West, east, south, north of the outer edges, in crs, as matplotlib takes them."""
        (west, south), (east, north) = self.box.tolist()
        return (west, east, south, north)

    @property
    def whole(self) -> Window:
        return Window(0, self.shape[0], 0, self.shape[1])

    def columns_rows(self, points: np.ndarray) -> np.ndarray:
        """Column and row (..., 2), with fractions, of points (..., 2 or more); the first cell begins at 0."""
        return (np.asarray(points)[..., :2] - self.origin) / self.step

    def index(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rows and columns (...) of the cells under points (..., 2 or more); those beyond take the outermost."""
        last = np.array(self.shape[::-1]) - 1
        at = np.clip(np.floor(self.columns_rows(points)), 0, last).astype(np.int64)
        return at[..., 1], at[..., 0]

    def middles(self, window: Window | None = None) -> np.ndarray:
        """Coordinates (rows, columns, 2) in crs of the middles of all cells, or of those of a window."""
        window = window or self.whole
        columns = np.arange(window.left, window.right) + 0.5
        rows = np.arange(window.top, window.bottom) + 0.5
        places = np.meshgrid(self.origin[0] + columns * self.step[0], self.origin[1] + rows * self.step[1])
        return np.stack(places, axis=-1)

    def windows(self, cells: int) -> Iterator[Window]:
        """Windows of up to ``cells`` rows and columns that cover the raster, row by row."""
        rows, columns = self.shape
        for top in range(0, rows, cells):
            for left in range(0, columns, cells):
                yield Window(top, min(top + cells, rows), left, min(left + cells, columns))


def plan_box(points: np.ndarray) -> np.ndarray:
    """Lowest and highest corner (2, 2) of points (N, 2 or more) in plan."""
    return np.array([points[:, :2].min(axis=0), points[:, :2].max(axis=0)])
