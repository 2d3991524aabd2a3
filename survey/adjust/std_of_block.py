"""Tilt, bending and shift of the block: effect of its errors on heights from place to place.

Over a slope, a block that lies beside its place shows heights of other places. At a fixed place in plan the error of a
height is ``e_z - s . e_xy``, with e the error of the point where the rays meet and s the slope of the bed there. With
the moves M of a place by the parameters and C their covariance, that of e is ``(M - N) C (M - N)'``, N the mean of the
moves of heights over the bed: what lifts all heights alike is left to `survey.adjust.std_common`.

A slope holds for a few pixels only. Where the block lies farther beside its place, as with positions of GPS alone, the
heights that are there count in place of slopes: the mean square of their differences over all displacements.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from survey.adjust.adjustment import Adjustment
from survey.adjust.bed_cells import BedCells
from survey.adjust.common_error import place_moves
from survey.adjust.std_common import interpolated, places_of, seen_places

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# The slope of the bed is that over cells of so many ground sampling distances: single heights are noisy.
_CELL_GSD = 2.0
# Points at a time: 300 bytes each.
_PORTION = 200_000


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
    cells = BedCells.of(xyz, _CELL_GSD * gsd)
    towards = np.column_stack([-cells.slopes, np.ones(len(xyz))])
    rise, reached = cells.squared_rise(np.sqrt(np.maximum(covariance.mean(axis=0)[[0, 4]], 0.0)))
    not_by_slopes = rise - (cells.slopes**2 * reached).sum(axis=1)
    std = np.empty(len(xyz), dtype=np.float32)
    for first in range(0, len(xyz), _PORTION):
        part = slice(first, first + _PORTION)
        there = interpolated(ties.start[:, :2], covariance, xyz[part, :2]).reshape(-1, 3, 3)
        by_slopes = np.einsum("na,nab,nb->n", towards[part], there, towards[part])
        std[part] = np.sqrt(np.maximum(by_slopes + not_by_slopes[part], 0.0))
    return std
