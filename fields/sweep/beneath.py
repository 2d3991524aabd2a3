"""Bed beneath overhangs: pixels that agreement of heights alone takes for duplicates.

Heights are compared along the rays of pixels. Beside a depth step a ray may pass near two surfaces of one height, of
which only one becomes points; there the points that are kept are told apart in space.
"""

from __future__ import annotations

import cv2
import numpy as np

from fields.image_store import Masks
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.map_points import MapPoints, far_from, points_of_pixels, thin_out

# A pixel is beside a step where its map rises by more than this, in ground sampling distances, within so many pixels.
_STEP_GSD, _REACH_PX = 12.0, 6
# Side of the cells of the ground, and how much higher a kept point of the same cell is: in ground sampling distances.
_CELL_GSD, _OVER_GSD = 3.0, 8.0
# Least distance of points from each other, in ground sampling distances: those of neighbouring pixels of two maps of
# the same surface lie 0.7 from each other at most.
_APART_GSD = 0.75
# Of the maps that contain a point so many, and this share, hold it in a pixel: windows over an edge leave heights
# between both surfaces, which maps contain where they jump. At most this share of them see through it.
_LEAST_HOLDING, _SHARE_HOLDING, _MOST_AGAINST = 2, 0.7, 0.25
# Farther than this from all points, in ground sampling distances, one map that holds a point is enough, if at most as
# many see through it as hold it.
_ALONE_GSD = 1.5


def beside_steps(height: np.ndarray, gsd: float) -> np.ndarray:
    """Pixels (height, width) bool of a map [m] beside which it rises steeply."""
    side = 2 * _REACH_PX + 1
    return cv2.dilate(height, np.ones((side, side), np.uint8)) - height > _STEP_GSD * gsd


def add_beneath(stack: ViewStack, fit: Masks, sure: Masks, kept: Masks, gsd: float) -> None:
    """Update the ``kept`` pixels: add those of ``fit`` that lie beneath kept points and apart from all of them.

    ``stack`` has the height maps, ``sure`` are all pixels whose heights count against a point.
    """
    new = MapPoints.of(stack, (each & ~old for each, old in zip(fit, kept, strict=True)))
    new = new[far_from(stack, kept, new.xyz, _APART_GSD * gsd)]
    new = new[are_beneath(stack, kept, new.xyz, gsd, _OVER_GSD)]
    having, through, holding = new.votes(stack, sure, gsd)
    held = (holding >= _LEAST_HOLDING) & (holding >= _SHARE_HOLDING * having)
    _mark_thinned(new[held & (through <= _MOST_AGAINST * having)], kept, _APART_GSD * gsd)
    alone = new[(holding >= 1) & (holding >= through)]
    alone = alone[far_from(stack, kept, alone.xyz, _ALONE_GSD * gsd)]
    _mark_thinned(alone, kept, _ALONE_GSD * gsd)


def _mark_thinned(points: MapPoints, kept: Masks, distance: float) -> None:
    points[thin_out(points.xyz.T, distance)].mark(kept, True)


def are_beneath(
    stack: ViewStack, kept: Masks, xyz: np.ndarray, gsd: float, over_gsd: float, around: int = 0
) -> np.ndarray:
    """Points (3, N) with a kept point more than ``over_gsd`` over them: (N,) bool.

    It is in the same cell of the ground, or in one of those ``around`` it.
    """
    if not xyz.size:
        return np.zeros(0, dtype=bool)
    steps = range(-around, around + 1)
    column, row = _columns_and_rows(xyz, gsd)
    wanted = np.stack([_number(column + x, row + y) for x in steps for y in steps])
    cells, cell_of = np.unique(wanted, return_inverse=True)
    top = np.full(len(cells), -np.inf, dtype=np.float32)
    for number, mask in enumerate(kept):
        points = points_of_pixels(stack, number, np.flatnonzero(mask))
        key = _number(*_columns_and_rows(points, gsd))
        place = np.minimum(np.searchsorted(cells, key), len(cells) - 1)
        same = cells[place] == key
        np.maximum.at(top, place[same], points[2][same])
    return top[cell_of.reshape(wanted.shape)].max(axis=0) > xyz[2] + over_gsd * gsd


def _columns_and_rows(xyz: np.ndarray, gsd: float) -> np.ndarray:
    """Cells (2, N) of the ground of points (3, N)."""
    return np.floor(xyz[:2] / np.float32(_CELL_GSD * gsd)).astype(np.int64)


def _number(column: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Number of cells of the ground."""
    return (row << 32) + column
