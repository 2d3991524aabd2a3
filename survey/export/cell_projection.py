"""Projection of the cells of a window into a photograph, through the water.

The way through the water is solved at every sixteenth cell and at three heights; between these the pixel changes so
evenly that linear steps in plan and parabolas in height leave a hundredth of a pixel.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from geo.crs import height_unit_m
from geo.reproject import Reprojection
from refract import FlatWater, PinholeCamera
from survey.export.plan_cells import PlanCells, Window
from survey.run.flight import Flight

WINDOW = 512
_STEP = 16
# Heights of one window differ by this at least, so that there is a parabola through them [m].
_LEAST_RELIEF_M = 0.01


@dataclass(frozen=True)
class CellProjection:
    """Projection of cells into a camera, (rows, columns) each; NaN where it does not see them."""

    # u, v: [px]
    u: np.ndarray
    v: np.ndarray
    cos_incidence: np.ndarray  # [-]: of the ray in air, to the normal of the water
    lean: np.ndarray  # [-]: square of the tangent of the angle between the straight line to the camera and the vertical

    def where(self, seen: np.ndarray) -> CellProjection:
        """The same where ``seen`` (rows, columns) bool, else NaN."""
        return CellProjection(*(np.where(seen, x, np.nan) for x in (self.u, self.v, self.cos_incidence, self.lean)))


class Windows:
    """The windows of a raster in which the bed has a height, ready to be looked up in photographs.

    Parameters
    ----------
    flight : Flight
    cells : PlanCells
    heights : callable
        Heights (rows, columns) [m] of a window, NaN where there is none. Asked again for each photograph that shows it.
    """

    def __init__(self, flight: Flight, cells: PlanCells, heights: Callable[[Window], np.ndarray]):
        self._water, self._heights = flight.water, heights
        self._windows = []
        for window in cells.windows(WINDOW):
            height = heights(window)
            if np.isfinite(height).any():
                self._windows.append(_Knots.of(flight, cells, window, height))

    def all(self) -> Iterator[tuple[Window, np.ndarray]]:
        """Each window with its heights."""
        for knots in self._windows:
            yield knots.window, self._heights(knots.window)

    def through(self, camera: PinholeCamera) -> Iterator[tuple[Window, np.ndarray, CellProjection]]:
        """The windows of which a camera may see something, with their heights, and how it sees them."""
        for knots in self._windows:
            found = knots.seen_by(camera, self._water)
            if found is not None:
                height = self._heights(knots.window)
                yield knots.window, height, knots.at_cells(found, height, camera)


@dataclass(frozen=True)
class _Knots:
    """The places of a window at which ways through the water are solved."""

    window: Window
    # middle, half [m]: the heights are ``middle - half``, ``middle``, ``middle + half``
    middle: float
    half: float
    # rows, columns (cells, knots): weights that interpolate between knots
    rows: np.ndarray
    columns: np.ndarray
    points: np.ndarray  # (3, knots, knots, 3) [m], local

    @staticmethod
    def of(flight: Flight, cells: PlanCells, window: Window, height: np.ndarray) -> _Knots:
        low, high = float(np.nanmin(height)), float(np.nanmax(height))
        middle, half = 0.5 * (low + high), max(0.5 * (high - low), 0.5 * _LEAST_RELIEF_M)
        rows, columns = (_knots(n) for n in window.shape)
        east = cells.west + (window.left + columns + 0.5) * cells.side[0]
        north = cells.north - (window.top + rows + 0.5) * cells.side[1]
        levels = np.array([middle - half, middle, middle + half]) / height_unit_m(cells.crs)
        points = np.stack(np.meshgrid(levels, north, east, indexing="ij")[::-1], axis=-1)
        across, along = _between(rows, window.shape[0]), _between(columns, window.shape[1])
        return _Knots(window, middle, half, across, along, _local(flight, cells, points))

    def seen_by(self, camera: PinholeCamera, water: FlatWater | None) -> np.ndarray | None:
        """Values of `CellProjection` (4, 3, knots, knots) at the knots; None where surely no cell is seen."""
        pixels, size = camera.project(self.points, water), np.array([camera.width, camera.height])
        with np.errstate(invalid="ignore"):
            # A window is larger than a photograph where its cells are larger than pixels: then knots lie around it.
            known = np.isfinite(pixels).all(axis=-1)
            if not known.any() or (pixels[known].min(axis=0) > size).any() or (pixels[known].max(axis=0) < 0.0).any():
                return None
        up = np.array((0.0, 0.0, 1.0) if water is None else water.up)
        cosine = -(camera.directions(np.where(known[..., None], pixels, 0.0)) @ up)
        to_camera = camera.centre - self.points
        lean = (to_camera[..., :2] ** 2).sum(axis=-1) / to_camera[..., 2] ** 2
        return np.stack([pixels[..., 0], pixels[..., 1], cosine, lean])

    def at_cells(self, found: np.ndarray, height: np.ndarray, camera: PinholeCamera) -> CellProjection:
        """Values at the cells, interpolated from the knots by their heights."""
        t = (height - self.middle) / self.half
        u, v, cosine, lean = (self._parabola(values, t) for values in found)
        with np.errstate(invalid="ignore"):
            seen = (u >= 0.0) & (u < camera.width) & (v >= 0.0) & (v < camera.height)
        return CellProjection(u, v, cosine, lean).where(seen)

    def _parabola(self, values: np.ndarray, t: np.ndarray) -> np.ndarray:
        below, middle, above = (self.rows @ level @ self.columns.T for level in values)
        return middle + 0.5 * (above - below) * t + (0.5 * (above + below) - middle) * t**2


def _local(flight: Flight, cells: PlanCells, points: np.ndarray) -> np.ndarray:
    """Points (..., 3) in the crs of cells as local ones."""
    frame = flight.frame
    if not cells.crs.equals(frame.crs):
        points = Reprojection.between(cells.crs, frame.crs)(points.reshape(-1, 3)).reshape(points.shape)
    return frame.local_from_crs(points)


def _knots(count: int) -> np.ndarray:
    """Cells at which ways are solved, the first and the last among them."""
    return np.unique(np.append(np.arange(0, count, _STEP), [count - 1]))


def _between(knots: np.ndarray, count: int) -> np.ndarray:
    """Weights (count, knots) that interpolate linearly between knots."""
    return np.stack([np.interp(np.arange(count), knots, row) for row in np.eye(len(knots))], axis=1)
