"""What errors of an adjusted block do to heights from place to place: it may lie askew, bent, and beside its place.

Over a slope, a block that lies beside its place shows heights of other places. At a fixed place in plan the error of a
height is ``e_z - s . e_xy``, with e the error of the point where the rays meet and s the slope of the bed there. With
the moves M of a place by the parameters and C their covariance, that of e is ``(M - N) C (M - N)'``, N the mean of the
moves of heights over the bed: what lifts all heights alike is left to `survey.adjust.std_common`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from survey.adjust.adjustment import Adjustment
from survey.adjust.common_error import place_moves
from survey.adjust.std_common import interpolated, places_of, seen_places

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# The slope of the bed is that over cells of so many ground sampling distances: single heights are noisy.
_CELL_GSD = 2.0
# Points whose variances along both axes multiply to less than this, in cells, lie in a row.
_LEAST_SPREAD = 1e-3
# Points at a time: 300 bytes each.
_PORTION = 200_000
# No more cells than this for each point, of a cloud with single points far away.
_MOST_CELLS = 8


def std_of_block(xyz: np.ndarray, survey: Survey, found: Adjustment, gsd: float) -> np.ndarray:
    """Standard deviation (N,) float32 [m] of heights at their places in plan by poses, lens and water.

    Without what all heights have in common.

    Parameters
    ----------
    xyz : (N, 3) [m], local
    survey : Survey
        As the points were made with it.
    found : Adjustment
    gsd : [m]
        Ground sampling distance.

    Returns
    -------
    (N,) float32 [m]
        Zero where no two views see the bed.
    """
    ties = seen_places(places_of(xyz), survey)
    if not len(ties):
        return np.zeros(len(xyz), dtype=np.float32)
    moves = place_moves(found, survey.water, ties)
    moves[:, 2] -= moves[:, 2].mean(axis=0)
    covariance = np.einsum("kai,ij,kbj->kab", moves, found.covariance, moves).reshape(len(ties), 9)
    towards = np.column_stack([-slopes_of(xyz, _CELL_GSD * gsd), np.ones(len(xyz))])
    std = np.empty(len(xyz), dtype=np.float32)
    for first in range(0, len(xyz), _PORTION):
        part = slice(first, first + _PORTION)
        there = interpolated(ties.start[:, :2], covariance, xyz[part, :2]).reshape(-1, 3, 3)
        std[part] = np.sqrt(np.maximum(np.einsum("na,nab,nb->n", towards[part], there, towards[part]), 0.0))
    return std


def slopes_of(xyz: np.ndarray, cell: float) -> np.ndarray:
    """Rise (N, 2) of a bed along x and y at its points (N, 3): of planes through the points of 3 x 3 square cells [m].

    Zero where points lie in a row.
    """
    low, wide = xyz[:, :2].min(axis=0), np.ptp(xyz[:, :2], axis=0)
    cell = max(cell, float(np.sqrt(wide.prod() / (_MOST_CELLS * len(xyz)))))
    place = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)
    shape = place.max(axis=0) + 1
    flat, number = place[:, 0] * shape[1] + place[:, 1], int(shape.prod())

    def nearby(weights: np.ndarray) -> np.ndarray:
        """Means over the nine cells about each cell, of what its points add up to."""
        return ndimage.uniform_filter(np.bincount(flat, weights, number).reshape(shape), 3, mode="constant")

    x, y, z = (xyz - xyz.mean(axis=0)).T
    count = np.maximum(nearby(np.ones(len(xyz))), 1.0 / 9.0)
    mean_x, mean_y, mean_z = (nearby(each) / count for each in (x, y, z))
    xx, yy, xy = nearby(x * x) / count - mean_x**2, nearby(y * y) / count - mean_y**2, nearby(x * y) / count
    xy, xz, yz = xy - mean_x * mean_y, nearby(x * z) / count - mean_x * mean_z, nearby(y * z) / count - mean_y * mean_z
    size = xx * yy - xy**2
    is_plane = size > _LEAST_SPREAD * cell**4
    size = np.where(is_plane, size, np.inf)
    along = np.stack([(yy * xz - xy * yz) / size, (xx * yz - xy * xz) / size])
    return along[:, place[:, 0], place[:, 1]].T
