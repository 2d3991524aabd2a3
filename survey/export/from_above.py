"""Points visible from above: a terrain model has one height per place, the highest.

Points are binned into squares of about a pixel. A point that lies well below the highest ones of its own and the
neighbouring squares is under a roof (a hull, a deck) or on a wall, which covers no area in plan. Where the bed drops
down such a wall, matching leaves it uncertain by a pixel or two where exactly, so that a point beside it may be wrong
by the whole drop.
"""

from __future__ import annotations

import math

import numpy as np
from scipy import ndimage

# Side of a square [px]: about one point in each.
_SQUARE_PX = 1.25
# Steeper than this is a wall [-].
_STEEPEST = 3.0
# Squares over which the place of a wall is uncertain, to either side.
_WALL_SQUARES = 2
# Standard deviations by which a point's height is lowered before it counts as a roof: a badly known one is none.
_STD_OF_ROOF = 2.0
# Squares around a tile that decide about its points.
MARGIN_SQUARES = _WALL_SQUARES + 1


def margin_of(pixel: float) -> float:
    """How far around a place points decide about it [m], for a pixel [m]."""
    return MARGIN_SQUARES * _SQUARE_PX * pixel


def seen_from_above(
    plan: np.ndarray, height: np.ndarray, std: np.ndarray, pixel: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which points nothing covers, and how uncertain they are because of walls.

    Parameters
    ----------
    plan : (N, 2) [m]
    height, std : (N,) [m]
    pixel : [m]
        What a pixel of the photographs covers.

    Returns
    -------
    is_seen : (N,) bool
    wall_std : (N,) [m]
        Standard deviation of the height by the place of walls; 0 away from them.
    """
    square = _SQUARE_PX * pixel
    # Counted from the origin of the plan, so that tiles have the same squares.
    at = np.floor(plan / square).astype(np.int64)
    at += MARGIN_SQUARES - at.min(axis=0)
    shape = at.max(axis=0) + 1 + MARGIN_SQUARES
    number = at[:, 0] * shape[1] + at[:, 1]
    top = np.full(shape.prod(), -np.inf)
    np.maximum.at(top, number, height - _STD_OF_ROOF * std)
    top = top.reshape(shape)
    roof = ndimage.grey_erosion(ndimage.grey_dilation(top, size=(3, 3)), size=(3, 3))
    allowed = _STEEPEST * square + _STD_OF_ROOF * std
    is_seen = height >= roof.ravel()[number] - allowed
    across = 2 * _WALL_SQUARES + 1
    lowest = ndimage.grey_erosion(np.where(np.isfinite(top), top, np.inf), size=(across, across))
    with np.errstate(invalid="ignore"):
        drop = np.nan_to_num(roof - lowest, nan=0.0, posinf=0.0, neginf=0.0) - _STEEPEST * _WALL_SQUARES * square
    # Anywhere between the top and the bottom of the wall.
    return is_seen, np.maximum(drop, 0.0).ravel()[number] / math.sqrt(3.0)
