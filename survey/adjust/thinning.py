"""Tie-point thinning: long tracks first, spread evenly over every photograph.

A block of 30 photographs has some 10,000 matches in each. Neighbours share errors of waves, relief and lens, so that
a few hundred, well spread, determine a photograph as well as all of them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from survey.photos.tie_points import TiePoints

# How many points an adjustment takes: of each of so many cells along a photograph, so many.
CELLS, PER_CELL = 8, 3


def thinned(ties: TiePoints, sizes: Sequence[tuple[int, int]], cells: int, per_cell: int) -> np.ndarray:
    """Numbers of the points (K,) to keep, ascending.

    Parameters
    ----------
    ties : TiePoints
    sizes : (width, height) [px] of each photograph
    cells : int
        Each photograph is divided into that many along its longer side.
    per_cell : int
        Points are taken until each cell has as many, or all that it has.
    """
    if not len(ties):
        return np.zeros(0, dtype=np.int64)
    size = np.array(sizes, dtype=np.float64)[ties.view]
    side = size.max(axis=1) / cells
    across = np.ceil(size[:, 0] / side)
    column, row = np.floor(ties.pixel / side[:, None]).T
    _, cell = np.unique(np.column_stack([ties.view, row * across + column]), axis=0, return_inverse=True)
    cell = cell.ravel()
    have = np.zeros(cell.max() + 1, dtype=np.int64)
    first = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    length = np.diff(first)
    keep = []
    # Of equally long tracks in order of a fixed shuffle: those of pycolmap come photograph by photograph.
    shuffle = np.random.default_rng(0).permutation(len(ties))
    for point in shuffle[np.argsort(-length[shuffle], kind="stable")]:
        cells_of_point = cell[first[point] : first[point + 1]]
        if (have[cells_of_point] < per_cell).any():
            have[cells_of_point] += 1
            keep.append(point)
    return np.sort(np.array(keep, dtype=np.int64))
