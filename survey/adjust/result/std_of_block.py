"""Relative heights of a block: its tilt, bending and shift, and parts of it that share no points.

On a slope, a horizontal shift of the block becomes an error of the height. At a fixed place in plan the error of a
height is ``e_z - s . e_xy``, with e the error of the point where the rays meet and s the slope of the bed there. With
the moves M of a place by the parameters and C their covariance, that of e is ``(M - N) C (M - N)'``, N the mean of the
moves of heights over the bed: what lifts all heights alike is left to `survey.adjust.result.std_common`.

A slope holds for a few pixels only. Where the block lies farther beside its place, as with positions of GPS alone, the
heights that are there count in place of slopes: the mean square of their differences over all displacements.

Photographs of two places with nothing between them that matches, as where a survey crosses deep water, are adjusted
together, and share the lens and the water; where one part lies against another, positions and control alone tell.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage

from geo.shapes import portions
from refract import FlatWater
from survey.adjust.block.normal_matrix import propagated
from survey.adjust.result.adjustment import Adjustment, Residuals
from survey.adjust.result.std_common import (
    PORTION,
    height_jacobian_over_area,
    interpolated,
    place_jacobian,
    places_of,
    seen_places,
)
from survey.display.quantities import length, listed
from survey.photos.poses import connected_parts

if TYPE_CHECKING:
    from survey.folder.survey import Survey


# The slope of the bed is that over cells of so many ground sampling distances: single heights are noisy.
_CELL_GSD = 2.0
# Points whose variances along both axes multiply to less than this, in cells, lie in a row.
_LEAST_SPREAD = 1e-3
# Most cells per point, for a cloud with single points far away.
_MOST_CELLS = 8
# Displacements of more standard deviations are left out.
_TRUNCATED = 4.0


def std_of_block(
    xyz: np.ndarray, survey: Survey, found: Adjustment, gsd: float, out: np.ndarray | None = None
) -> np.ndarray:
    """Standard deviation (N,) float32 [m] of heights at their places in plan by poses, lens and water.

    Without what all heights have in common.

    Parameters
    ----------
    xyz : (N, 3) [m], local
    survey : Survey
        As the points were made with it.
    gsd : [m]
        Ground sampling distance.
    out : (N,) float32, optional
        Where the result goes, which may lie in a file.

    Returns
    -------
    (N,) float32 [m]
        Zero where no two views see the bed.
    """
    ties = seen_places(places_of(xyz), survey)
    std = np.empty(len(xyz), dtype=np.float32) if out is None else out
    if not len(ties):
        std[:] = 0.0
        return std
    jacobian = place_jacobian(found, survey.water, ties)
    jacobian[:, 2] -= jacobian[:, 2].mean(axis=0)
    covariance = propagated(jacobian, found.covariance.matrix).reshape(len(ties), 9)
    cells = BedCells.of(xyz, _CELL_GSD * gsd)
    rise, reached = cells.squared_rise(np.sqrt(np.maximum(covariance.mean(axis=0)[[0, 4]], 0.0)))
    not_by_slopes = rise - (cells.slope**2 * reached).sum(axis=0)
    for part in portions(len(xyz), PORTION):
        points = xyz[part]
        covariances = interpolated(ties.start[:, :2], covariance, points[:, :2]).reshape(-1, 3, 3)
        towards = np.column_stack([-cells.at(cells.slope, points), np.ones(len(points))])
        by_slopes = np.einsum("na,nab,nb->n", towards, covariances, towards)
        std[part] = np.sqrt(np.maximum(by_slopes + cells.at(not_by_slopes, points), 0.0))
    return std


@dataclass(frozen=True)
class BedCells:
    """Planes through the points of 3 x 3 square cells, about each cell."""

    low: np.ndarray  # (2,) [m]: where the first column and row begin
    side: float  # [m]
    seen: np.ndarray  # (columns, rows) bool: whether there are points
    # (columns, rows) [m]: in the middle of the cell, over the mean of all points; 0 where none are seen
    height: np.ndarray
    slope: np.ndarray  # (2, columns, rows): rise along x and y; 0 where points lie in a row

    @classmethod
    def of(cls, xyz: np.ndarray, side: float) -> BedCells:
        """Cells of points (N, 3) [m], with sides [m] of that length, or longer where single points lie far away."""
        low, wide = xyz[:, :2].min(axis=0), np.ptp(xyz[:, :2], axis=0)
        side = max(side, float(np.sqrt(wide.prod() / (_MOST_CELLS * len(xyz)))))
        shape = _cells_of(xyz[:, :2].max(axis=0), low, side) + 1
        origin = xyz.mean(axis=0)
        # Of each cell the sums of what is in `_products`.
        sums = np.zeros((9, int(shape.prod())))
        for part in portions(len(xyz), PORTION):
            place = _cells_of(xyz[part, :2], low, side)
            for total, weights in zip(sums, _products(xyz[part] - origin), strict=True):
                np.add.at(total, place[:, 0] * shape[1] + place[:, 1], weights)
        # Means over the nine cells about each cell.
        about = [ndimage.uniform_filter(each.reshape(shape), 3, mode="constant") for each in sums]
        seen = about[0] > 0.5 / 9.0
        count = np.maximum(about[0], 1.0 / 9.0)
        mean_x, mean_y, mean_z, xx, yy, xy, xz, yz = (each / count for each in about[1:])
        xx, yy, xy = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
        xz, yz = xz - mean_x * mean_z, yz - mean_y * mean_z
        size = xx * yy - xy**2
        size = np.where(size > _LEAST_SPREAD * side**4, size, np.inf)
        slope = np.stack([(yy * xz - xy * yz) / size, (xx * yz - xy * xz) / size])
        middle_x, middle_y = (
            start - middle + side * (np.arange(cells) + 0.5)
            for start, middle, cells in zip(low, origin, shape, strict=False)
        )
        height = mean_z + slope[0] * (middle_x[:, None] - mean_x) + slope[1] * (middle_y - mean_y)
        return cls(low, side, seen, np.where(seen, height, 0.0), slope)

    def at(self, values: np.ndarray, xyz: np.ndarray) -> np.ndarray:
        """Values (..., columns, rows) of the cells at some of the points (N, 3) [m], (N, ...)."""
        place = _cells_of(xyz[:, :2], self.low, self.side)
        return np.moveaxis(values, (-2, -1), (0, 1))[place[:, 0], place[:, 1]]

    def squared_rise(self, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean squares of the rise from each cell to places beside it, over normal displacements.

        Parameters
        ----------
        std : (2,) [m]
            Of the displacement along x and y.

        Returns
        -------
        (columns, rows) [m^2]
            Of the bed as far as it is seen.
        (2, columns, rows) [m^2]
            Mean squares of the displacements that whole cells make of it: much less than a cell is none.
        """
        kernels = [_kernel(each / self.side) for each in std]
        squares = [kernel * (np.arange(len(kernel)) - len(kernel) // 2) ** 2 for kernel in kernels]
        seen = self.seen.astype(np.float64)
        share = np.maximum(_filtered(seen, kernels), 1e-9)
        mean, square = (_filtered(each, kernels) / share for each in (self.height, self.height**2))
        rise = np.maximum(square - 2.0 * self.height * mean + self.height**2, 0.0)
        reached = [_filtered(seen, each) / share for each in ([squares[0], kernels[1]], [kernels[0], squares[1]])]
        return rise, self.side**2 * np.stack(reached)


def _cells_of(xy: np.ndarray, low: np.ndarray, side: float) -> np.ndarray:
    """Column and row (..., 2) of the cells of places (..., 2) [m]."""
    return np.floor((xy - low) / side).astype(np.int64)


def _products(xyz: np.ndarray) -> tuple[np.ndarray, ...]:
    """1, x, y, z, xx, yy, xy, xz and yz of points (N, 3)."""
    x, y, z = xyz.T
    return np.ones(len(x)), x, y, z, x * x, y * y, x * y, x * z, y * z


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


# Runs of photographs that are named.
_MOST_RUNS = 6


@dataclass(frozen=True)
class Part:
    """A part of an adjusted block."""

    names: tuple[str, ...]  # Of its photographs
    listed: str  # The same as runs of neighbours, "a to d, f, k to m"
    num_points: int  # Tie points
    apart_m: float  # Between the nearest cameras of this part and another
    # Standard deviation of its mean height by water, lens and poses; None with too few points to tell
    height_std_m: float | None
    to_first_std_m: float | None  # That of its mean height less that of the first part; None for the first itself


def part_numbers(found: Adjustment) -> np.ndarray:
    """Part of each view by shared tie points, without marks of control (`survey.photos.poses.connected_parts`)."""
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    return connected_parts(len(found.poses.names), found.residuals.point[is_tie], found.residuals.view[is_tie])


def parts_of_adjustment(found: Adjustment, water: FlatWater | None) -> tuple[Part, ...]:
    """The parts of an adjusted block, the largest first; none where it is whole."""
    number = part_numbers(found)
    if number.max() < 1:
        return ()
    parts: list[Part] = []
    first: np.ndarray | None = None
    for each in range(int(number.max()) + 1):
        views = np.flatnonzero(number == each)
        own = _only(found, number == each)
        jacobian = height_jacobian_over_area(own, water)
        mean = jacobian.mean(axis=0) if len(jacobian) else None
        first = mean if each == 0 else first
        others = found.poses.centres[(number != each) & (number >= 0)]
        between = np.linalg.norm(found.poses.centres[views][:, None] - others[None], axis=-1)
        to_first = None if each == 0 or mean is None or first is None else _std(found, mean - first)
        parts.append(
            Part(
                names=tuple(found.poses.names[view] for view in views),
                listed=_runs(found.poses.names, views),
                num_points=len(own.points),
                apart_m=float(between.min()),
                height_std_m=None if mean is None else _std(found, mean),
                to_first_std_m=to_first,
            )
        )
    return tuple(parts)


def parts_warning(found: Adjustment, water: FlatWater | None) -> list[str]:
    """Warning where a block falls into parts."""
    parts = parts_of_adjustment(found, water)
    if not parts:
        return []
    sizes = [f"{len(part.names)} ({part.listed})" for part in parts]
    known = [part.to_first_std_m for part in parts if part.to_first_std_m is not None]
    by = f", which determine their relative height to {length(max(known))} (1 sigma)" if known else ""
    return [
        f"the photographs fall into {len(parts)} parts without common points, of {', '.join(sizes[:-1])} and "
        f"{sizes[-1]} photographs: only positions, control and water connect them{by}; where they should be one block, "
        "fly more overlap between them"
    ]


def _only(found: Adjustment, keep: np.ndarray) -> Adjustment:
    """An adjustment with only the tie points of views (V,) bool; the covariance stays."""
    is_tie = found.residuals.point < len(found.points) - len(found.control)
    is_kept = is_tie & keep[found.residuals.view]
    kept, point = np.unique(found.residuals.point[is_kept], return_inverse=True)
    residuals = Residuals(
        found.residuals.view[is_kept], found.residuals.px[is_kept], found.residuals.at_px[is_kept], point
    )
    return replace(found, residuals=residuals, points=found.points[kept])


def _runs(names: tuple[str, ...], views: np.ndarray) -> str:
    """Names of views (K,), ascending, those of neighbours as their first and last."""
    runs = np.split(views, np.flatnonzero(np.diff(views) > 1) + 1)
    spans = [names[run[0]] if len(run) == 1 else f"{names[run[0]]} to {names[run[-1]]}" for run in runs]
    return listed(spans, _MOST_RUNS)


def _std(found: Adjustment, jacobian: np.ndarray) -> float:
    return math.sqrt(max(float(jacobian @ found.covariance.matrix @ jacobian), 0.0))
