"""The square cells of a raster in plan: where they lie, and which point is in which."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from pyproj import CRS

from geo.projection import ground_units_m
from survey.errors import SurveyError

# What a raster may hold: more is a resolution by mistake, or a stray point far away.
_MOST_CELLS = 4_000_000_000
# A point on the outer edge lies in the last cell, and a cell's edge is where it was meant to be, to rounding.
_ON_EDGE = 1e-6
# Steps of resolutions that are chosen, times a power of ten.
_ROUND = (1.0, 2.0, 2.5, 5.0, 10.0)


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
        """Rows and columns."""
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
        return (
            slice(self.top - larger.top, self.bottom - larger.top),
            slice(self.left - larger.left, self.right - larger.left),
        )


@dataclass(frozen=True)
class PlanCells:
    """Cells whose edges lie at multiples of their side, so that rasters of one resolution fit together.

    Their side is a length on the ground, whatever the unit and the scale of the map (`geo.projection.ground_units_m`).
    """

    crs: CRS
    # west, north in crs: outer corner of the first cell
    west: float
    north: float
    side: tuple[float, float]  # (east, north), in units of crs
    side_m: float  # [m], on the ground
    shape: tuple[int, int]  # (rows, columns): rows run from north to south

    @staticmethod
    def over(points_crs: np.ndarray, crs: CRS, side_m: float) -> PlanCells:
        """The cells of this side [m] that cover points (N, 2 or more).

        Raises
        ------
        SurveyError
            If they are too many for a raster.
        """
        low, high = points_crs[:, :2].min(axis=0), points_crs[:, :2].max(axis=0)
        side = side_m / ground_units_m(crs, 0.5 * (low + high))
        first = np.floor(low / side + _ON_EDGE)
        last = np.ceil(high / side - _ON_EDGE)
        columns, rows = (int(n) for n in np.maximum(last - first, 1))
        if rows * columns > _MOST_CELLS:
            raise SurveyError(
                f"a raster of {columns} x {rows} cells of {side_m:g} m is too large; give a larger --resolution, or "
                "[area] bounds without the strays that lie far off"
            )
        west, north = float(first[0] * side[0]), float(last[1] * side[1])
        return PlanCells(crs, west, north, (float(side[0]), float(side[1])), side_m, (rows, columns))

    @property
    def transform(self) -> tuple[float, float, float, float, float, float]:
        """Coefficients a to f of ``east = a column + b row + c, north = d column + e row + f``."""
        return (self.side[0], 0.0, self.west, 0.0, -self.side[1], self.north)

    def finer(self, side_m: float) -> PlanCells:
        """Cells of another side over the same place."""
        rows, columns = self.shape
        east, north = self.west + columns * self.side[0], self.north - rows * self.side[1]
        return PlanCells.over(np.array([[self.west, north], [east, self.north]]), self.crs, side_m)

    def place(self, points_crs: np.ndarray) -> np.ndarray:
        """Column and row (N, 2) of points (N, 2 or more), from the outer corner of the first cell, with fractions."""
        return np.column_stack(
            [(points_crs[:, 0] - self.west) / self.side[0], (self.north - points_crs[:, 1]) / self.side[1]]
        )

    def middles(self, window: Window) -> np.ndarray:
        """Coordinates (rows, columns, 2) in crs of the middles of the cells of a window."""
        columns = np.arange(window.left, window.right) + 0.5
        rows = np.arange(window.top, window.bottom) + 0.5
        east, north = np.meshgrid(self.west + columns * self.side[0], self.north - rows * self.side[1])
        return np.stack([east, north], axis=-1)

    def windows(self, cells: int) -> Iterator[Window]:
        """Windows of up to ``cells`` rows and columns that cover the raster, row by row."""
        rows, columns = self.shape
        for top in range(0, rows, cells):
            for left in range(0, columns, cells):
                yield Window(top, min(top + cells, rows), left, min(left + cells, columns))


def round_side(side_m: float) -> float:
    """The next larger round length: 0.083 becomes 0.1."""
    power = 10.0 ** math.floor(math.log10(side_m))
    return next(float(f"{step * power:.6g}") for step in _ROUND if step * power >= side_m * (1.0 - 1e-9))
