"""The bed as a raster of heights, with what is known of each cell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from geo.crs import height_unit_m
from survey.export.plan_cells import PlanCells, Window
from survey.export.water_level import LevelFit


@dataclass(frozen=True)
class Gridded:
    """The bed in cells; arrays (rows, columns), in files.

    Attributes
    ----------
    cells : PlanCells
    height : float32 [m]
        Mean height of the bed over the cell, seen from above; of no meaning where `known` is not set.
    std : float32 [m]
        Standard deviation of that height by errors of its own.
    common : float32 [m]
        Standard deviation by what all heights have in common, water, lens and poses, as far as the run knows it.
    count : uint32
        Points that the height is from; 0 where it was filled.
    known : uint8
        1 where the cell has points, 2 where it was filled from its neighbours, else 0.
    incidence : float32 [rad]
        Mean angle in air at which its points were seen.
    level : LevelFit or None
        Height of the water; None for a dry survey.
    pixel_m : [m]
        What a pixel of the photographs covers.
    """

    cells: PlanCells
    height: np.ndarray
    std: np.ndarray
    common: np.ndarray
    count: np.ndarray
    known: np.ndarray
    incidence: np.ndarray
    level: LevelFit | None
    pixel_m: float

    def heights(self, window: Window) -> np.ndarray:
        """Heights (rows, columns) float64 [m] of a window, NaN where there is none."""
        at = window.slices
        return np.where(self.known[at] > 0, self.height[at].astype(np.float64), np.nan)

    def stds(self, window: Window) -> np.ndarray:
        """Standard deviations (rows, columns) float64 [m] by all errors, NaN where there is no height."""
        at = window.slices
        return np.where(self.known[at] > 0, np.hypot(self.std[at].astype(np.float64), self.common[at]), np.nan)

    def depths(self, window: Window) -> np.ndarray:
        """Depth under the water (rows, columns) float64 [m], negative above it; NaN without height or water."""
        if self.level is None:
            return np.full(window.shape, np.nan)
        return self.level(self.cells.middles(window)) - self.heights(window)

    @property
    def height_unit_m(self) -> float:
        """The unit of heights in crs [m]."""
        return height_unit_m(self.cells.crs)
