"""Tiles of a survey: rectangles of the ground that are worked on one after the other, so that memory is bounded."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from fields.sweep.block import Overlap
from survey.plan.area import AREA_MARGIN_M, grown, local_area
from survey.plan.block import camera_of
from survey.plan.ground import dry_ground

if TYPE_CHECKING:
    from survey.folder.survey import Survey
    from survey.plan.plan import Plan

Area = tuple[float, float, float, float]

# Maps reach this far beyond a tile [ground sampling distances]: windows of the solver with their halo (8), and points
# about which neighbours are counted (4). Windows of the sweep come on top, in pixels of each photograph.
RIM_GSD = 8.0


@dataclass(frozen=True)
class Tiling:
    """Tiles of a rectangle, row by row from the south-west.

    Attributes
    ----------
    x, y : tuple of float [m], local
        Lines between the tiles, the outer ones included, rising.
    rim : float [m]
        By which the maps of a tile reach into its neighbours.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    rim: float

    @staticmethod
    def of(ground: Area, count: int, rim: float) -> Tiling:
        """So many equal tiles of a ground (x0, y0, x1, y1), as square as their number allows."""
        width, height = ground[2] - ground[0], ground[3] - ground[1]
        pairs = [(n, count // n) for n in range(1, count + 1) if count % n == 0]
        columns, rows = min(pairs, key=lambda pair: abs(math.log(width / pair[0] * pair[1] / height)))
        x, y = np.linspace(ground[0], ground[2], columns + 1), np.linspace(ground[1], ground[3], rows + 1)
        return Tiling(tuple(x.tolist()), tuple(y.tolist()), rim)

    def __len__(self) -> int:
        return (len(self.x) - 1) * (len(self.y) - 1)

    def _lines(self, number: int) -> tuple[int, int]:
        row, column = divmod(number, len(self.x) - 1)
        return row, column

    def cell(self, number: int) -> Area:
        """Rectangle of the points of a tile, its west and south sides included; without end at the outer sides."""
        row, column = self._lines(number)
        x, y = (-math.inf, *self.x[1:-1], math.inf), (-math.inf, *self.y[1:-1], math.inf)
        return x[column], y[row], x[column + 1], y[row + 1]

    def ground(self, number: int, margin: float) -> Area:
        """Rectangle of a tile with a margin [m] at the sides where another tile follows."""
        row, column = self._lines(number)
        west, south, east, north = (
            margin if is_inner else 0.0
            for is_inner in (column > 0, row > 0, column + 2 < len(self.x), row + 2 < len(self.y))
        )
        return self.x[column] - west, self.y[row] - south, self.x[column + 1] + east, self.y[row + 1] + north


def inside(xy: np.ndarray, cell: Area) -> np.ndarray:
    """Mask of the places (..., 2) in a rectangle whose west and south sides belong to it."""
    x, y = xy[..., 0], xy[..., 1]
    return (x >= cell[0]) & (y >= cell[1]) & (x < cell[2]) & (y < cell[3])


def ground_of(survey: Survey, plan: Plan) -> Area:
    """Rectangle of the ground that a survey wants: its bounds, or what two views see at the rough height of the bed."""
    area = local_area(survey)
    if area is not None:
        return grown(area, AREA_MARGIN_M)
    height = 0.0 if survey.water is not None else dry_ground(survey).height
    overlap = Overlap([camera_of(view, plan) for view in survey.views], survey.water, height)
    seen = overlap.cells[overlap.seen.sum(axis=0) >= 2, :2]
    seen = seen if len(seen) else overlap.cells[:, :2]
    # The bed may lie lower, so that views show more of it: half of a footprint.
    reach = 0.5 * max(plan.footprint_m)
    return (*(seen.min(axis=0) - reach).tolist(), *(seen.max(axis=0) + reach).tolist())
