"""Standard deviations of heights by the errors that all points share: water, lens and poses.

Matching errors differ from point to point and average out; an error of the water level does not. The rays of the views
that show a place meet where

    sum over views of |observed pixel - predicted pixel(place, parameters)|^2   is least,

so that the place moves by ``-(A' A)^-1 A' B`` times a small change of the parameters, A and B the derivatives of the
predictions by the place and by the parameters. With the covariance of the parameters this gives that of the heights, of
each at its place (`std_common`). Worked out at places spread over the bed, wet and dry apart, and interpolated in plan.
The covariance is that of the adjustment; without one the parameters count as independent, as good as survey.toml says
or else as the defaults of `survey.adjust.block.priors` say, poses and lens those of an adjusted block. An error of all
places in plan, of a transformation of datums, is one of heights where the bed slopes.

What differs from place to place, tilt, bending and shift of the block, is in the std of its points, too
(`std_of_block`). At a fixed place in plan the error of a height is ``e_z - s . e_xy``, with e the error of the point
where the rays meet and s the slope of the bed there. With the moves M of a place by the parameters and C their
covariance, that of e is ``(M - N) C (M - N)'``, N the mean of the moves of heights over the bed: what lifts all heights
alike. A slope holds for a few pixels only. Where the block lies farther beside its place, as with positions of GPS
alone, the heights that are there count in place of slopes: the mean square of their differences over all displacements.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import ndimage
from scipy.spatial import cKDTree

from geo.shapes import portions
from refract import FlatWater
from survey.adjust.block.normal_matrix import propagated, propagated_variance
from survey.adjust.block.observed import original_rows
from survey.adjust.block.prediction import design_matrix, linearise
from survey.adjust.block.priors import EXACT_STD_DEG, EXACT_STD_M, prior_of
from survey.adjust.block.state import NUM_RELIEF, NUM_WATER, Layout, State
from survey.adjust.result.adjustment import Adjustment
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints

# Squares along the longer side of the bed, from each of which one place at most is taken, of wet and dry points each.
_SQUARES = 14
# A place counts with the views that see it, of which these are enough for its geometry.
_VIEWS = 12
# Places that a point is interpolated from.
_NEAREST = 4
# Points at a time: 300 bytes each.
PORTION = 200_000
# The slope of the bed is that over cells of so many ground sampling distances: single heights are noisy.
_CELL_GSD = 2.0
# Cells are so much smaller than a shift in plan, as far as sampling distances allow.
_CELL_SHARE = 0.1
# Points whose variances along both axes multiply to less than this, in cells, lie in a row.
_LEAST_SPREAD = 1e-3
# Most cells per point, for a cloud with single points far away.
_MOST_CELLS = 8
# Displacements of more standard deviations are left out.
_TRUNCATED = 4.0
# Lower bound: no height is exact.
_LEAST_M = 1e-5

BASIS_ADJUSTED = "the covariance of the adjustment"
BASIS_STATED = (
    "the standard deviations in survey.toml or the defaults of water, with poses and lens as good as those of an "
    f"adjusted block ({100 * EXACT_STD_M:g} cm, {EXACT_STD_DEG:g} degrees) where nothing is stated"
)


def place_jacobian(found: Adjustment, water: FlatWater | None, ties: TiePoints) -> np.ndarray:
    """Jacobian (K, 3, P) of places, local, by the parameters of `Adjustment.covariance`."""
    state = replace(found.state(water), points=ties.start)
    return place_jacobian_at(found.layout, state, ties, original_rows(ties, found.lenses, found.poses.lens_of))


def place_jacobian_at(layout: Layout, state: State, ties: TiePoints, rows: np.ndarray) -> np.ndarray:
    """Jacobian (K, 3, P) of places, those of the state, by water, lenses and poses.

    ``rows`` (N,) as `survey.adjust.block.observed.original_rows` gives them.
    """
    linear = linearise(layout, state, ties, np.zeros((len(ties.view), NUM_RELIEF)), rows)
    kept = np.r_[:NUM_WATER, layout.first_lens : len(layout)]
    design, jacobian = design_matrix(layout, ties.view, linear.by_parameters), np.empty((len(ties), 3, len(kept)))
    for number, (first, end) in enumerate(pairwise(np.searchsorted(ties.point, np.arange(len(ties) + 1)))):
        by_point = linear.by_point[first:end].reshape(-1, 3)
        jacobian[number] = -(np.linalg.pinv(by_point) @ design[2 * first : 2 * end].toarray()[:, kept])
    return jacobian


def std_common(
    xyz: np.ndarray,
    wet: np.ndarray,
    survey: Survey,
    found: Adjustment | None,
    gsd: float,
    out: Sequence[np.ndarray] = (),
) -> np.ndarray:
    """Standard deviation (N,) float32 [m] of heights by water, lens and poses, of points (N, 3) [m], local.

    NaN where no place of the same kind, wet (N,) bool or dry, is seen by two views. The survey is the one that the
    points were made with; no adjustment was found where poses and water were used as they came. The result goes into
    the first of ``out``, (N,) float32, which may lie in files; that of places in plan, along one axis [m] (the root
    mean square of east and north), into the second, where there is one.
    """
    stds = out or [np.empty(len(xyz), dtype=np.float32)]
    std, *in_plan = stds
    for each in stds:
        each[:] = np.nan
    for is_wet in (True, False):
        ties = seen_places(places_of(xyz, wet == is_wet), survey)
        if not len(ties):
            continue
        x, y, z = _variances(survey, found, ties, gsd)
        variance = np.column_stack([z, 0.5 * (x + y)])[:, : len(stds)]
        for part in portions(len(xyz), PORTION):
            kind = wet[part] == is_wet
            of_points = np.sqrt(interpolated(ties.start[:, :2], variance, xyz[part][kind, :2]))
            for each, values in zip(stds, of_points.T, strict=True):
                each[part][kind] = values
    if survey.plan_std_m > 0.0:
        std[:] = np.hypot(std, shift_std(xyz, survey.plan_std_m, gsd))
        for each in in_plan:
            each[:] = np.hypot(each, survey.plan_std_m)
    return np.maximum(std, np.float32(_LEAST_M), out=std)


def std_of_block(
    xyz: np.ndarray, survey: Survey, found: Adjustment, gsd: float, out: np.ndarray | None = None
) -> np.ndarray:
    """Standard deviation (N,) float32 [m] of heights at their places in plan by poses, lens and water.

    Without what all heights have in common; zero where no two views see the bed. Arguments are those of `std_common`.
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
    not_by_slopes = cells.beyond_slopes(np.sqrt(np.maximum(covariance.mean(axis=0)[[0, 4]], 0.0)))
    for part in portions(len(xyz), PORTION):
        points = xyz[part]
        covariances = interpolated(ties.start[:, :2], covariance, points[:, :2]).reshape(-1, 3, 3)
        towards = np.column_stack([-cells.at(cells.slope, points), np.ones(len(points))])
        by_slopes = np.einsum("na,nab,nb->n", towards, covariances, towards)
        std[part] = np.sqrt(np.maximum(by_slopes + cells.at(not_by_slopes, points), 0.0))
    return std


def shift_std(xyz: np.ndarray, plan_std_m: float, gsd: float) -> np.ndarray:
    """Standard deviation (N,) [m] of heights (N, 3) at their places, if all of a cloud may be shifted in plan.

    On a slope that is slope times shift, over a bed of any shape the root mean square of differences to heights around.
    """
    cells = BedCells.of(xyz, max(_CELL_GSD * gsd, _CELL_SHARE * plan_std_m))
    variance = plan_std_m**2 * np.sum(cells.slope**2, axis=0) + cells.beyond_slopes(np.full(2, plan_std_m))
    return cells.at(np.sqrt(np.maximum(variance, 0.0)), xyz)


def places_of(xyz: np.ndarray, mask: np.ndarray | None = None) -> np.ndarray:
    """Points (K, 3) of a cloud, or those in a ``mask`` (N,) bool, spread over its plan.

    Of each square the one nearest to its middle; the first of equally near ones.
    """
    low, high = np.full(2, np.inf), np.full(2, -np.inf)
    for part in portions(len(xyz), PORTION):
        xy = xyz[part, :2] if mask is None else xyz[part, :2][mask[part]]
        if len(xy):
            low, high = np.minimum(low, xy.min(axis=0)), np.maximum(high, xy.max(axis=0))
    if not np.isfinite(low).all():
        return np.empty((0, 3))
    side = max(float((high - low).max()), 1e-9) / _SQUARES
    # Index, square and distance to its middle of the nearest of each portion.
    nearest = np.empty((3, 0))
    for part in portions(len(xyz), PORTION):
        count = len(xyz[part])
        index = part.start + (np.arange(count) if mask is None else np.flatnonzero(mask[part]))
        square, within = np.divmod((xyz[index, :2] - low) / side, 1.0)
        # One number for each square: rows of two take three times as long.
        number = square @ np.array([_SQUARES + 1.0, 1.0])
        found = np.stack([index, number, np.sum((within - 0.5) ** 2, axis=1)])
        found = np.concatenate([nearest, found], axis=1)
        order = np.lexsort((found[0], found[2]))
        nearest = found[:, order[np.unique(found[1, order], return_index=True)[1]]]
    return xyz[np.sort(nearest[0].astype(np.int64))]


def seen_places(places: np.ndarray, survey: Survey) -> TiePoints:
    """Places that two views see, each with some of its views; occlusion is not tested."""
    inside = np.zeros((len(places), len(survey.views)), dtype=bool)
    pixels = np.zeros((*inside.shape, 2))
    for number, each in enumerate(survey.views):
        camera = each.camera
        pixels[:, number] = at = camera.project(places, survey.water)
        inside[:, number] = camera.sees(at)
    enough = np.flatnonzero(inside.sum(axis=1) >= 2)
    chosen = [_some(np.flatnonzero(inside[place])) for place in enough]
    point = np.repeat(np.arange(len(enough)), [len(some) for some in chosen])
    seen_by = np.concatenate([np.empty(0, dtype=np.int64), *chosen])
    return TiePoints(places[enough], point, seen_by, pixels[enough[point], seen_by])


def _some(views: np.ndarray) -> np.ndarray:
    """Sample of at most `_VIEWS` of these, spread over them."""
    return views[np.linspace(0, len(views) - 1, min(len(views), _VIEWS)).round().astype(np.int64)]


def _variances(survey: Survey, found: Adjustment | None, ties: TiePoints, gsd: float) -> np.ndarray:
    """Variances (3, K) [m^2] of places along x, y and z, local."""
    if found is not None:
        jacobian = np.moveaxis(place_jacobian(found, survey.water, ties), 1, 0)
        return np.stack([propagated_variance(along, found.covariance.matrix) for along in jacobian])
    prior, of_water = prior_of(survey, gsd, free_water=True), prior_of(survey, gsd).std[:NUM_WATER]
    std = np.concatenate([of_water, prior.std[prior.layout.first_lens :]])
    # Structure from motion and poses without any word on them have no standard deviation of their own.
    std = np.where(np.isfinite(std), std, EXACT_STD_M)
    rows = ties.pixel[:, 1]
    jacobian = place_jacobian_at(prior.layout, replace(prior.state, points=ties.start), ties, rows)
    return np.stack([(along**2) @ std**2 for along in np.moveaxis(jacobian, 1, 0)])


def interpolated(at: np.ndarray, values: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Values (K, ...) at places (K, 2) as at places (N, 2) they are: means, weighted by the inverse square distance."""
    count = min(_NEAREST, len(at))
    tree, found = cKDTree(at), np.empty((len(places), *values.shape[1:]))
    for part in portions(len(places), PORTION):
        distance, index = tree.query(places[part], k=list(range(1, count + 1)), workers=-1)
        weight = 1.0 / (distance**2 + 1e-6)
        weight = (weight / weight.sum(axis=1, keepdims=True)).reshape(*weight.shape, *(1,) * (values.ndim - 1))
        found[part] = (weight * values[index]).sum(axis=1)
    return found


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

    def beyond_slopes(self, std: np.ndarray) -> np.ndarray:
        """Mean squares (columns, rows) [m^2] of the rise by displacements, less what slopes make of them."""
        rise, reached = self.squared_rise(std)
        return rise - np.sum(self.slope**2 * reached, axis=0)

    def squared_rise(self, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean squares (columns, rows) [m^2] of the rise to places beside each cell, by normal displacements.

        Of the bed as far as it is seen. ``std`` (2,) [m] is that of the displacement along x and y. Also returns the
        mean squares (2, columns, rows) of the displacements that whole cells make of it: much less than a cell is none.
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
