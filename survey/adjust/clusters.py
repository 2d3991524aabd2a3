"""Correlated errors of neighbouring observations: the design effect of cluster samples.

`cluster_design_effect`
    Neighbours in one photograph look through the same wave and lie on the same relief. In a square of a photograph with
    m observations whose errors correlate by rho, the variance of their mean is that of one times
    ``(1 + (m - 1) rho) / m`` (L. Kish, Survey Sampling, 1965, section 5.4).
`terrain_design_effect`
    Neighbouring ground has common errors in all photographs that show it, as windows are matched with the same piece of
    the bed in each. So lift, tilt, bending and shift of the whole block vary by more than its normal equations say. How
    much more follows from the residuals, summed over squares of the ground (the covariance that is robust against
    clusters, K.-Y. Liang and S. Zeger, Longitudinal data analysis using generalized linear models, 1986). Let d be the
    change of the predictions by such a motion of the block with the points re-adjusted, w the weights and r the
    residuals: a square has the sum ``s = sum of w d . r``. With independent errors s^2 has the mean
    ``sum of w d^2 - g' C g``, with g the sum of w d by the parameters and C their covariance; the second term, which
    the parameters absorb, grows with the square.
"""

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree

from evaluation.summary import std_by_median
from survey.adjust.block.bundle import Solution
from survey.adjust.block.observed import Sizes
from survey.adjust.block.prediction import linearise
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import NUM_WATER, State
from survey.adjust.result.std_common import place_jacobian_at
from survey.photos.poses import TiePoints

# Sides of the squares, as shares of the longer side of a photograph: the one with the largest design effect counts.
_SIDES = (0.04, 0.08, 0.16)
# Residuals of more standard deviations count as that many.
_MOST = 3.0
# Windows that are beside each other lie within so many sides.
_BESIDE = 2.5
# The same as shares of what the longer side of a photograph shows on the ground.
_SIDES_ON_GROUND = (0.08, 0.16, 0.32)
# Fewer squares tell nothing.
_FEWEST = 20
# Places along the longer side of the block, at each of which one point says what a change of the parameters does.
_PLACES = 8


def cluster_design_effect(
    ties: TiePoints, residuals: np.ndarray, std_px: np.ndarray, kind: np.ndarray, sizes: Sizes
) -> np.ndarray:
    """Factors (N,), at least 1, on the variances of observations of residuals (N, 2) [px]; each kind (N,) has one.

    ``std_px`` (kinds,) is the standard deviation of a pixel coordinate of each kind.
    """
    length = np.linalg.norm(residuals, axis=1, keepdims=True)
    bound = _MOST * std_px[kind][:, None]
    normal = residuals * np.minimum(1.0, bound / np.maximum(length, 1e-12)) / std_px[kind][:, None]
    side = np.array([max(size) for size in sizes], dtype=np.float64)[ties.view]
    out = np.ones(len(kind))
    for number in range(len(std_px)):
        of_kind = kind == number
        if of_kind.any():
            found = [
                _design_effect(ties.view[of_kind], ties.pixel[of_kind], normal[of_kind], s * side[of_kind])
                for s in _SIDES
            ]
            out[of_kind] = max(1.0, *found)
    return out


def _design_effect(view: np.ndarray, pixel: np.ndarray, normal: np.ndarray, side: np.ndarray) -> float:
    cell = _numbered(np.column_stack([view, np.floor(pixel / side[:, None])]))
    count = np.bincount(cell).astype(np.float64)
    pairs = float((count * (count - 1.0)).sum())
    if pairs == 0.0:
        return 1.0
    sums = np.stack([np.bincount(cell, weights=axis) for axis in normal.T], axis=-1)
    square = float(np.sum(normal**2))
    correlation = (float(np.sum(sums**2)) - square) / (pairs * square / len(normal))
    return 1.0 + (float((count**2).sum() / count.sum()) - 1.0) * max(correlation, 0.0)


def shared_variance(ties: TiePoints, residuals: np.ndarray, chosen: np.ndarray, window_px: float) -> float:
    """Variance [px^2] of a coordinate that windows of a side share with those beside them in a photograph, as in waves.

    The mean product of residuals (N, 2) [px] of those that are ``chosen`` (N,) bool; 0 where none is beside another.
    Blur, noise and compression scatter each alone, but windows that overlap. Residuals are bounded, as for a design
    effect.
    """
    total, count, chosen = 0.0, 0, chosen & np.isfinite(residuals).all(axis=1)
    if not chosen.any():
        return 0.0
    bound = _MOST * std_by_median(residuals[chosen])
    residuals = np.clip(residuals, -bound, bound)
    for view in np.unique(ties.view[chosen]):
        own = np.flatnonzero(chosen & (ties.view == view))
        one, other = own[cKDTree(ties.pixel[own]).query_pairs(_BESIDE * window_px, output_type="ndarray")].T
        apart = np.linalg.norm(ties.pixel[one] - ties.pixel[other], axis=1) > window_px
        total += float(np.sum((residuals[one] * residuals[other])[apart]))
        count += 2 * int(np.count_nonzero(apart))
    return total / max(count, 1)


def _numbered(cells: np.ndarray) -> np.ndarray:
    """Numbers (N,) from 0 on of cells given by columns (N, K), however far apart they are."""
    places = [np.unique(column, return_inverse=True)[1] for column in cells.T]
    _, number = np.unique(np.ravel_multi_index(places, [each.max() + 1 for each in places]), return_inverse=True)
    return number


def terrain_design_effect(problem: Problem, solution: Solution, sizes: Sizes, kinds: np.ndarray) -> float:
    """Design effect on the variance of height, tilt and shift of the whole block, over its normal equations.

    Of observations of some kinds, (N,) bool; one where too little ground is seen to tell.
    """
    ties, state, layout = problem.ties, solution.state, problem.layout
    linear = linearise(layout, state, ties, problem.rise_design, problem.rows)
    weights = np.where(kinds, solution.weights, 0.0)
    used = weights > 0.0
    residuals, by_point, design = (
        np.where(used.reshape(-1, *[1] * (each.ndim - 1)), each, 0.0)
        for each in (solution.residuals, linear.by_point, linear.by_parameters)
    )
    of_block = _of_block(problem, state, used) @ solution.covariance
    change = design @ np.moveaxis(of_block[:, layout.columns], 0, -1)[ties.view]
    changes = PredictionChanges(
        weights, residuals, _followed(ties, weights, by_point, change), design, layout.columns[ties.view]
    )
    # What the longer side of a photograph shows on the ground [m], with straight rays.
    distance = np.linalg.norm(state.points[ties.point] - state.centres[ties.view], axis=1)
    longer = np.array([max(size) for size in sizes], dtype=np.float64)
    footprint = float(np.median(distance * (longer / state.lenses[layout.lens_of, 0])[ties.view]))
    found = []
    for share in _SIDES_ON_GROUND:
        side = share * footprint
        square = _numbered(np.floor(state.points[:, :2] / side))[ties.point]
        if len(np.unique(square[used])) >= _FEWEST:
            found.append(float(np.mean(changes.ratios(square, solution.covariance))))
    return max(found, default=1.0)


def _of_block(problem: Problem, state: State, used: np.ndarray) -> np.ndarray:
    """Derivatives (6, P) of mean height, tilt, bending and shift in plan of the block by the parameters.

    By points of which enough observations are ``used`` (N,): others may lie behind a camera.
    """
    layout, ties = problem.layout, problem.ties
    # A control point may have a single mark, which tells of no move.
    tracked = np.flatnonzero(np.bincount(ties.point[used], minlength=len(ties)) >= ties.least)
    plan = state.points[:, :2]
    side = max(float(np.ptp(plan, axis=0).max()), 1e-9) / _PLACES
    _, first = np.unique(np.floor(plan[tracked] / side), axis=0, return_index=True)
    chosen = np.sort(tracked[first])
    kept = used & np.isin(ties.point, chosen)
    rows = ties.pixel[kept, 1] if problem.rows is None else problem.rows[kept]
    some = ties.only(kept)
    jacobian = place_jacobian_at(layout, replace(state, points=state.points[chosen]), some, rows)
    east, north = (plan[chosen] - plan[chosen].mean(axis=0)).T
    level = np.column_stack([np.ones_like(east), east, north])
    bent = np.linalg.pinv(np.column_stack([level, east**2 + north**2]))[3]
    rises = np.vstack([np.linalg.pinv(level), bent]) @ jacobian[:, 2]
    found = np.vstack([rises, jacobian[:, :2].mean(axis=0)])
    return np.insert(found, [NUM_WATER] * (layout.first_lens - NUM_WATER), 0.0, axis=1)


def _followed(ties: TiePoints, weights: np.ndarray, by_point: np.ndarray, change: np.ndarray) -> np.ndarray:
    """Changes (N, 2, K) of the predictions with the points re-adjusted (eliminated)."""
    first = np.searchsorted(ties.point, np.arange(len(ties)))
    weighted = np.moveaxis(by_point * weights[:, None, None], 1, 2)
    own, right = (np.add.reduceat(weighted @ each, first, axis=0) for each in (by_point, change))
    step = np.linalg.pinv(own, hermitian=True) @ right
    return change - by_point @ step[ties.point]


@dataclass(frozen=True)
class PredictionChanges:
    """Changes of the predicted observations by C changes of the parameters."""

    weights: np.ndarray  # (N,) [1/px^2]
    residuals: np.ndarray  # (N, 2) [px]
    changes: np.ndarray  # (N, 2, C) [px]
    design: np.ndarray  # (N, 2, K): derivatives of each observation by the parameters that it depends on
    columns: np.ndarray  # (N, K) int64: their numbers

    def ratios(self, square: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Ratios (C,) of the squared sums over squares of ground to their expectation for independent errors.

        Each observation has the number of its square (N,); of the covariance (P, P) of the parameters what belongs to
        the photographs of one square counts.
        """
        weighted = self.weights[:, None, None] * self.changes
        total, num = np.einsum("nac,nac->c", weighted, self.changes), weighted.shape[2]
        sums = np.zeros((square.max() + 1, num))
        np.add.at(sums, square, np.einsum("nac,na->nc", weighted, self.residuals))
        # Observations in a square that depend on the same parameters count as one: g of each, by the changes.
        keys, of_key = np.unique(square * (self.columns.max() + 1) + self.columns[:, -1], return_inverse=True)
        summed = csr_array((np.ones(len(of_key)), of_key, np.arange(len(of_key) + 1)), (len(of_key), len(keys))).T
        taken = np.moveaxis(weighted, 1, 2) @ self.design
        taken = (summed @ taken.reshape(len(taken), -1)).reshape(len(keys), num, -1)
        first = np.zeros(len(keys), dtype=np.int64)
        first[of_key] = np.arange(len(of_key))
        rows = np.broadcast_to((num * square[first])[:, None, None] + np.arange(num)[:, None], taken.shape)
        columns = np.broadcast_to(self.columns[first][:, None], taken.shape)
        by_square = csr_array((taken.ravel(), (rows.ravel(), columns.ravel())), (num * len(sums), len(covariance)))
        left = total.copy()
        # All rows of a square have entries in the same columns.
        for start, after, end in by_square.indptr[np.arange(0, num * len(sums), num)[:, None] + (0, 1, num)]:
            at, g = by_square.indices[start:after], by_square.data[start:end].reshape(num, -1)
            left -= np.sum((g @ covariance[at[:, None], at]) * g, axis=1)
        return np.sum(sums**2, axis=0) / np.maximum(left, 1e-12 * total + 1e-300)
