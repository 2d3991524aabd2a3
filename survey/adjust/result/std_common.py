"""Standard deviation of heights by the errors that all points share: water, lens and poses.

Matching errors differ from point to point and average out; an error of the water level does not. The rays of the views
that show a place meet where

    sum over views of |observed pixel - predicted pixel(place, parameters)|^2   is least,

so that the place moves by ``-(A' A)^-1 A' B`` times a small change of the parameters, A and B the derivatives of the
predictions by the place and by the parameters. With the covariance of the parameters this gives that of the heights: of
their mean over the area (`common_error`), and of each at its place (`std_common`). What of it differs from place to
place (tilt, bend, the bank against the bed) is in the std of the points of an adjusted block, too:
`survey.adjust.result.std_of_block`. An error of all places in plan, of a transformation of datums, is one of heights
where the bed slopes.

Worked out at places spread over the bed, wet and dry apart, and interpolated in plan. The covariance is that of the
adjustment; without one the parameters count as independent, as good as survey.toml says or else as the defaults of
`survey.adjust.block.priors` say, poses and lens those of an adjusted block.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from geo.shapes import portions
from refract import FlatWater
from survey.adjust.block.normal_matrix import propagated_variance
from survey.adjust.block.observed import original_rows
from survey.adjust.block.prediction import design_matrix, linearise
from survey.adjust.block.priors import EXACT_STD_DEG, EXACT_STD_M, parameters_of, prior_of
from survey.adjust.block.state import NUM_RELIEF, NUM_WATER, Layout, State
from survey.adjust.result.adjustment import Adjustment
from survey.photos.poses import TiePoints, least_track

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# Squares along the longer side of the bed, from each of which one place at most is taken, of wet and dry points each.
_SQUARES = 14
# A place counts with the views that see it, of which these are enough for its geometry.
_VIEWS = 12
# Places that a point is interpolated from.
_NEAREST = 4
# Points at a time: 300 bytes each.
PORTION = 200_000
# Cells along the longer side of the grid that tells what a shift of the cloud does.
_MOST_CELLS = 1000
# Lower bound: no height is exact.
_LEAST_M = 1e-5

BASIS_ADJUSTED = "the covariance of the adjustment"
BASIS_STATED = (
    "the standard deviations in survey.toml or the defaults of water, with poses and lens as good as those of an "
    f"adjusted block ({100 * EXACT_STD_M:g} cm, {EXACT_STD_DEG:g} degrees) where nothing is stated"
)
# The standard deviation of a mean over this many places, spread over the area, is that over all to a few per cent.
_PLACES_OF_MEAN = 50
# The cloud has each place from several views, of which these are enough for an average geometry.
_VIEWS_OF_MEAN = 6
# Squares along the longer side of the area, from each of which one place at most is taken.
_SQUARES_OF_MEAN = 12


@dataclass(frozen=True)
class CommonError:
    """Standard deviation of the height by water, lens and poses [m]."""

    mean: float  # Of the mean height over the area: by so much the whole cloud may be too high or too low
    typical: float  # Median over the places of the standard deviation of the height there
    num_places: int


def common_error(found: Adjustment, water: FlatWater | None) -> CommonError | None:
    """Std of the mean height over an adjusted block, but for errors of single points; None without points.

    Parameters
    ----------
    water : FlatWater or None
        Local, as it was found.
    """
    jacobian = height_jacobian_over_area(found, water)
    if not len(jacobian):
        return None
    by_place = propagated_variance(jacobian, found.covariance.matrix)
    mean_jacobian = jacobian.mean(axis=0)
    return CommonError(
        mean=math.sqrt(float(propagated_variance(mean_jacobian, found.covariance.matrix))),
        typical=float(np.median(np.sqrt(by_place))),
        num_places=len(jacobian),
    )


def height_jacobian_over_area(found: Adjustment, water: FlatWater | None) -> np.ndarray:
    """Jacobian (K, P) of the heights of points spread over the area, by the parameters of the covariance."""
    ties = _places_of_mean(found)
    return place_jacobian(found, water, ties)[:, 2] if len(ties) else np.zeros((0, len(found.covariance.matrix)))


def place_jacobian(found: Adjustment, water: FlatWater | None, ties: TiePoints) -> np.ndarray:
    """Jacobian (K, 3, P) of places, local, by the parameters of `Adjustment.covariance`."""
    layout = found.layout
    if water is not None:
        x, y = found.covariance.water_point
        water = replace(water, point=(x, y, float(water.height(x, y))))
    lenses = np.array([parameters_of(lens) for lens in found.lenses])
    poses, readouts = found.poses, np.array(found.readouts_s or ())
    state = State(water, np.zeros(NUM_RELIEF), lenses, poses.centres, poses.rotations, ties.start, readouts)
    if poses.focals is not None:
        state = replace(state, focals=poses.focals)
    return place_jacobian_at(layout, state, ties, original_rows(ties, found.lenses, found.poses.lens_of))


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


def _places_of_mean(found: Adjustment) -> TiePoints:
    """Points of the adjustment spread over the area, each with some of the views that show it."""
    first = np.searchsorted(found.residuals.point, np.arange(len(found.points) + 1))
    seen = np.diff(first)
    enough = np.flatnonzero(seen >= least_track(len(found.poses.names)))
    if not len(enough):
        return TiePoints(np.empty((0, 3)), *(np.empty(0, dtype=np.int64),) * 2, np.empty((0, 2)))
    plan = found.points[enough, :2]
    side = max(float(np.ptp(plan, axis=0).max()), 1e-9) / _SQUARES_OF_MEAN
    # Of each square the point that most views show.
    order = np.argsort(-seen[enough], kind="stable")
    _, one = np.unique(np.floor((plan[order] - plan.min(axis=0)) / side), axis=0, return_index=True)
    chosen = np.sort(enough[order[one]])
    chosen = chosen[np.unique(np.linspace(0, len(chosen) - 1, _PLACES_OF_MEAN).round().astype(np.int64))]
    rows = [
        first[k] + np.linspace(0, seen[k] - 1, min(seen[k], _VIEWS_OF_MEAN)).round().astype(np.int64) for k in chosen
    ]
    at = np.concatenate(rows)
    point = np.repeat(np.arange(len(chosen)), [len(row) for row in rows])
    return TiePoints(found.points[chosen], point, found.residuals.view[at], found.residuals.at_px[at])


def std_common(
    xyz: np.ndarray,
    wet: np.ndarray,
    survey: Survey,
    found: Adjustment | None,
    gsd: float,
    out: np.ndarray | None = None,
    in_plan: np.ndarray | None = None,
) -> np.ndarray:
    """Standard deviation (N,) float32 [m] of heights by water, lens and poses.

    Parameters
    ----------
    xyz : (N, 3) [m], local
    wet : (N,) bool
    survey : Survey
        As the points were made with it.
    found : Adjustment or None
        None where poses and water were used as they came.
    gsd : [m]
        Ground sampling distance.
    out : (N,) float32, optional
        Where the result goes, which may lie in a file.
    in_plan : (N,) float32, optional
        Gets that of places in plan, along one axis [m]: the root mean square of east and north.

    Returns
    -------
    (N,) float32 [m]
        NaN where no place of the same kind, wet or dry, is seen by two views.
    """
    std = np.empty(len(xyz), dtype=np.float32) if out is None else out
    stds = [std] if in_plan is None else [std, in_plan]
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
        std[:] = np.hypot(std, shift_std(xyz, survey.plan_std_m))
        if in_plan is not None:
            in_plan[:] = np.hypot(in_plan, survey.plan_std_m)
    return np.maximum(std, np.float32(_LEAST_M), out=std)


def shift_std(xyz: np.ndarray, plan_std_m: float) -> np.ndarray:
    """Standard deviation (N,) [m] of heights at their places, if all of a cloud may be shifted in plan.

    On a slope that is slope times shift. Of a bed of any shape it is the root mean square of differences to heights
    around, at sqrt(2) standard deviations: on a slope, that is the same. Where nothing lies around, that of the cloud.

    Parameters
    ----------
    xyz : (N, 3) [m], local
    plan_std_m : [m]
        Of the shift, in east and in north.
    """
    low = xyz[:, :2].min(axis=0)
    side = max(0.5 * plan_std_m, float(np.ptp(xyz[:, :2], axis=0).max()) / _MOST_CELLS)
    column, row = ((xyz[:, :2] - low) / side).astype(np.int64).T
    reach = max(round(math.sqrt(2.0) * plan_std_m / side), 1)
    shape = np.array([row.max(), column.max()]) + 1 + 2 * reach
    flat = (row + reach) * shape[1] + column + reach
    count = np.bincount(flat, minlength=shape.prod())
    with np.errstate(invalid="ignore"):
        height = (np.bincount(flat, xyz[:, 2], shape.prod()) / count).reshape(shape)
    squares, num = np.zeros(shape), np.zeros(shape)
    diagonal = max(round(reach / math.sqrt(2.0)), 1)
    for rows, columns in ((0, reach), (reach, 0), (diagonal, diagonal), (diagonal, -diagonal)):
        # Shifts by whole cells differ a little from the wanted distance; this scales for it.
        factor = 2.0 * plan_std_m**2 / ((rows**2 + columns**2) * side**2)
        for sign in (1, -1):
            shifted = np.roll(height, (sign * rows, sign * columns), axis=(0, 1))
            known = np.isfinite(shifted) & np.isfinite(height)
            squares[known] += factor * (shifted[known] - height[known]) ** 2
            num += known
    with np.errstate(invalid="ignore"):
        std = np.sqrt(squares / num)
    of_cloud = np.sqrt(squares.sum() / max(num.sum(), 1.0))
    return np.where(np.isfinite(std), std, of_cloud).ravel()[flat]


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
