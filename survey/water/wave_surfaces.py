"""The surface of the water in each photograph, in plan, where the rays to the bed cross it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import ndimage

from fields.sweep.kernels.stack import PlaneWater
from fields.waves.waves import LEAST_DEPTH
from geo.crs import horizontal_crs
from geo.frames import LocalFrame
from geo.grid import Grid, plan_box
from refract import FlatWater, PinholeCamera, crossing_point

# Cells to a spacing of the coefficients.
_FINER = 2


@dataclass(frozen=True)
class WaveSurface:
    """The surface in a photograph."""

    name: str  # Of the photograph
    grid: Grid  # In the horizontal CRS of the survey, rows run south
    height: np.ndarray  # (rows, columns) float32 [m]: over the level in the photograph; NaN where not measured

    def without_tilt(self) -> WaveSurface:
        """Heights over the plane through them by least squares: errors of a pose tilt a surface, too."""
        row, column = np.nonzero(np.isfinite(self.height))
        by = np.column_stack([np.ones(len(row)), row, column])
        height, known = self.height.copy(), self.height[row, column]
        height[row, column] = known - by @ np.linalg.lstsq(by, known, rcond=None)[0]
        return replace(self, height=height)

    @property
    def std(self) -> float:
        """Standard deviation [m] of the heights."""
        return float(np.nanstd(self.height))


@dataclass(frozen=True)
class WaveSurfaces:
    """Surfaces of V photographs, cubic B-splines in the frame of the water (`fields.waves.waves.Waves`)."""

    names: Sequence[str]
    corner: np.ndarray  # (V, 2) [m]: of the first coefficient
    spacing: float  # [m]
    coefficients: np.ndarray  # (V, columns, rows) [m]
    cameras: Sequence[PinholeCamera]
    water: FlatWater
    frame: LocalFrame
    shown: str  # The photograph that waves displace most
    # (N, 6) [m]: of places (2) of the bed in it, displacements (2) by waves, and what surfaces leave of them (2)
    shifts: np.ndarray

    def shifts_in_crs(self, most: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places, displacements and what is left of them (M, 2) each, easting and northing; about ``most`` of them."""
        place, plane = self.shifts[:, :2], PlaneWater.of(self.water)
        side = np.sqrt(np.prod(np.ptp(place, axis=0)) / most) + 1e-9
        chosen = np.unique(np.floor(place / side), axis=0, return_index=True)[1]
        place, before, after = (self.shifts[chosen, k : k + 2] for k in (0, 2, 4))

        def in_crs(at: np.ndarray) -> np.ndarray:
            local = np.pad(at, ((0, 0), (0, 1))) @ plane.from_local + plane.origin
            return self.frame.crs_from_local(local)[:, :2]

        found = in_crs(place)
        return found, in_crs(place + before) - found, in_crs(place + after) - found

    def over(self, bed: np.ndarray) -> Iterator[WaveSurface]:
        """The surfaces of the photographs that show points (N, 3) [m], local, of the bed under water.

        Where a photograph shows none through a cell of the spacing of the coefficients, it has measured nothing.
        """
        low, high = plan_box(bed)
        row, column = Grid.southward_from(low, high, self.spacing).index(bed)
        # One point for each cell.
        thinned = bed[np.unique((row << 32) + column, return_index=True)[1]]
        for view in range(len(self.names)):
            crossing = self._crossings(view, thinned)
            if len(crossing):
                yield self._surface(view, crossing)

    def _surface(self, view: int, crossing: np.ndarray) -> WaveSurface:
        """The surface of a photograph where rays cross it (M, 3) [m], local."""
        in_crs = self.frame.crs_from_local(crossing)
        grid = Grid.southward_aligned(in_crs, horizontal_crs(self.frame.crs), self.spacing / _FINER)
        middles = grid.middles()
        level = np.full((*grid.shape, 1), in_crs[:, 2].mean())
        place = self._nodes(view, self.frame.local_from_crs(np.concatenate([middles, level], axis=-1)))
        height = ndimage.map_coordinates(
            self.coefficients[view], np.moveaxis(place, -1, 0), order=3, prefilter=False, mode="grid-wrap"
        )
        measured = np.zeros(self.coefficients.shape[1:], dtype=bool)
        measured[tuple(np.floor(self._nodes(view, crossing)).astype(int).T)] = True
        # Rays to neighbouring points can leave out a cell between them.
        measured = ndimage.binary_closing(measured, np.ones((3, 3), dtype=bool))
        at = np.floor(place).astype(int)
        inside = ((at >= 0) & (at < measured.shape)).all(axis=-1)
        at = np.where(inside[..., None], at, 0)
        known = inside & measured[at[..., 0], at[..., 1]]
        return WaveSurface(self.names[view], grid, np.where(known, height, np.nan).astype(np.float32))

    def _crossings(self, view: int, bed: np.ndarray) -> np.ndarray:
        """Where the rays to points under water (N, 3) that a photograph shows cross the plane (M, 3) [m], local."""
        camera = self.cameras[view]
        down = np.array([0.0, 0.0, -camera.tide])
        wet = bed[np.asarray(self.water.depth(bed + down)) > LEAST_DEPTH]
        seen = wet[camera.sees(camera.project(wet, self.water))] + down
        return crossing_point(seen, camera.centre + down, self.water)

    def _nodes(self, view: int, places: np.ndarray) -> np.ndarray:
        """Column and row (..., 2), with fractions, of places (..., 3) [m], local, among the coefficients."""
        plane = PlaneWater.of(self.water)
        return (((places - plane.origin) @ plane.from_local.T)[..., :2] - self.corner[view]) / self.spacing
