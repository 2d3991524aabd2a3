"""Tilt, bending and shift of the block: effect of its errors on heights from place to place.

Over a slope, a block that lies beside its place shows heights of other places. At a fixed place in plan the error of a
height is ``e_z - s . e_xy``, with e the error of the point where the rays meet and s the slope of the bed there. With
the moves M of a place by the parameters and C their covariance, that of e is ``(M - N) C (M - N)'``, N the mean of the
moves of heights over the bed: what lifts all heights alike is left to `survey.adjust.std_common`.

A slope holds for a few pixels only. Where the block lies farther beside its place, as with positions of GPS alone, the
heights that are there count in place of slopes: the mean square of their differences over all displacements.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from survey.adjust.adjustment import Adjustment
from survey.adjust.std_common import interpolated, place_moves, places_of, seen_places

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# The slope of the bed is that over cells of so many ground sampling distances: single heights are noisy.
_CELL_GSD = 2.0
# Points at a time: 300 bytes each.
_PORTION = 200_000
# Points whose variances along both axes multiply to less than this, in cells, lie in a row.
_LEAST_SPREAD = 1e-3
# No more cells than this for each point, of a cloud with single points far away.
_MOST_CELLS = 8
# Displacements of more standard deviations are left out.
_TRUNCATED = 4.0


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


@dataclass(frozen=True)
class BedCells:
    """Planes through the points of 3 x 3 square cells, about each cell; of N points.

    Attributes
    ----------
    place : (N, 2) int64
        Column and row of the cell of each point.
    side : [m]
    seen : (columns, rows) bool
        Whether there are points.
    height : (columns, rows) [m]
        In the middle of the cell, over the mean of all points; 0 where none are seen.
    slope : (2, columns, rows)
        Rise along x and y; 0 where points lie in a row.
    """

    place: np.ndarray
    side: float
    seen: np.ndarray
    height: np.ndarray
    slope: np.ndarray

    @classmethod
    def of(cls, xyz: np.ndarray, side: float) -> BedCells:
        """Cells of points (N, 3) [m], with sides [m] of that length, or longer where single points lie far away."""
        low, wide = xyz[:, :2].min(axis=0), np.ptp(xyz[:, :2], axis=0)
        side = max(side, float(np.sqrt(wide.prod() / (_MOST_CELLS * len(xyz)))))
        place = np.floor((xyz[:, :2] - low) / side).astype(np.int64)
        shape = place.max(axis=0) + 1
        flat, number = place[:, 0] * shape[1] + place[:, 1], int(shape.prod())

        def about(weights: np.ndarray) -> np.ndarray:
            """Means over the nine cells about each cell, of what its points add up to."""
            return ndimage.uniform_filter(np.bincount(flat, weights, number).reshape(shape), 3, mode="constant")

        origin = xyz.mean(axis=0)
        x, y, z = (xyz - origin).T
        count = about(np.ones(len(xyz)))
        seen = count > 0.5 / 9.0
        count = np.maximum(count, 1.0 / 9.0)
        mean_x, mean_y, mean_z = (about(each) / count for each in (x, y, z))
        xx, yy, xy = about(x * x) / count - mean_x**2, about(y * y) / count - mean_y**2, about(x * y) / count
        xy, xz, yz = xy - mean_x * mean_y, about(x * z) / count, about(y * z) / count
        xz, yz = xz - mean_x * mean_z, yz - mean_y * mean_z
        size = xx * yy - xy**2
        size = np.where(size > _LEAST_SPREAD * side**4, size, np.inf)
        slope = np.stack([(yy * xz - xy * yz) / size, (xx * yz - xy * xz) / size])
        middle_x, middle_y = (
            start - middle + side * (np.arange(cells) + 0.5)
            for start, middle, cells in zip(low, origin, shape, strict=False)
        )
        height = mean_z + slope[0] * (middle_x[:, None] - mean_x) + slope[1] * (middle_y - mean_y)
        return cls(place, side, seen, np.where(seen, height, 0.0), slope)

    @property
    def slopes(self) -> np.ndarray:
        """Rise (N, 2) along x and y at the points."""
        return self._at(np.moveaxis(self.slope, 0, -1))

    def squared_rise(self, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean squares of the rise from each point to places beside it, over normal displacements.

        Parameters
        ----------
        std : (2,) [m]
            Of the displacement along x and y.

        Returns
        -------
        (N,) [m^2]
            Of the bed as far as it is seen.
        (N, 2) [m^2]
            Mean squares of the displacements that whole cells make of it: much less than a cell is none.
        """
        kernels = [_kernel(each / self.side) for each in std]
        squares = [kernel * (np.arange(len(kernel)) - len(kernel) // 2) ** 2 for kernel in kernels]
        seen = self.seen.astype(np.float64)
        share = np.maximum(_filtered(seen, kernels), 1e-9)
        mean, square = (_filtered(each, kernels) / share for each in (self.height, self.height**2))
        rise = np.maximum(square - 2.0 * self.height * mean + self.height**2, 0.0)
        reached = [_filtered(seen, each) / share for each in ([squares[0], kernels[1]], [kernels[0], squares[1]])]
        return self._at(rise), self.side**2 * self._at(np.stack(reached, axis=-1))

    def _at(self, values: np.ndarray) -> np.ndarray:
        """Values (columns, rows, ...) of the cells at the points, (N, ...)."""
        return values[self.place[:, 0], self.place[:, 1]]


def _kernel(std: float) -> np.ndarray:
    """Weights of whole displacements of a normal law, both in cells."""
    most = int(_TRUNCATED * std + 0.5)
    weight = np.exp(-0.5 * (np.arange(-most, most + 1) / max(std, 1e-9)) ** 2)
    return weight / weight.sum()


def _filtered(values: np.ndarray, kernels: list[np.ndarray]) -> np.ndarray:
    # Imports scipy.stats, half a second: only for poses that were adjusted.
    from scipy import signal

    # By Fourier transforms: positions of GPS alone are off by a hundred cells.
    for axis, kernel in enumerate(kernels):
        values = signal.oaconvolve(values, np.expand_dims(kernel, 1 - axis), mode="same", axes=axis)
    return values
