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

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

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
# The same as shares of what the longer side of a photograph shows on the ground.
_SIDES_ON_GROUND = (0.08, 0.16, 0.32)
# Fewer squares tell nothing.
_FEWEST = 20
# Places along the longer side of the block, at each of which one point says what a change of the parameters does.
_PLACES = 8
# Squares whose covariances are gathered at a time: 200 kB each.
_AT_A_TIME = 64


def cluster_design_effect(
    ties: TiePoints, residuals: np.ndarray, std_px: np.ndarray, kind: np.ndarray, sizes: Sizes
) -> np.ndarray:
    """Factors (N,), at least 1, on the variances of observations.

    Parameters
    ----------
    residuals : (N, 2) [px]
    std_px : (kinds,) [px]
        Standard deviation of a pixel coordinate of each kind.
    kind : (N,)
        Each kind has one factor.
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
    cells = np.column_stack([view, np.floor(pixel / side[:, None])])
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    cell = cell.ravel()
    count = np.bincount(cell).astype(np.float64)
    pairs = float((count * (count - 1.0)).sum())
    if pairs == 0.0:
        return 1.0
    sums = np.stack([np.bincount(cell, weights=axis) for axis in normal.T], axis=-1)
    square = float(np.sum(normal**2))
    correlation = (float(np.sum(sums**2)) - square) / (pairs * square / len(normal))
    return 1.0 + (float((count**2).sum() / count.sum()) - 1.0) * max(correlation, 0.0)


def terrain_design_effect(problem: Problem, solution: Solution, sizes: Sizes, kinds: np.ndarray) -> float:
    """Design effect on the variance of height, tilt and shift of the whole block, over its normal equations.

    Parameters
    ----------
    kinds : (N,) bool
        Observations that count.

    Returns
    -------
    float
        One where too little ground is seen to tell.
    """
    ties, state = problem.ties, solution.state
    linear = linearise(problem.layout, state, ties, problem.rise_design, problem.rows)
    weights = np.where(kinds, solution.weights, 0.0)
    used = weights > 0.0
    residuals = np.where(used[:, None], solution.residuals, 0.0)
    design = csr_array(linear.by_parameters.multiply(np.repeat(used, 2)[:, None]))
    by_point = np.where(used[:, None, None], linear.by_point, 0.0)
    of_block = _of_block(problem, state, used) @ solution.covariance
    changes = [_followed(ties, weights, by_point, (design @ change).reshape(-1, 2)) for change in of_block]
    found = []
    for share in _SIDES_ON_GROUND:
        side = share * _footprint(problem, state, sizes)
        _, square = np.unique(np.floor(state.points[:, :2] / side), axis=0, return_inverse=True)
        square = square.ravel()[ties.point]
        if len(np.unique(square[used])) >= _FEWEST:
            changed = PredictionChanges(weights, residuals, np.stack(changes, axis=-1), design)
            found.append(float(np.mean(changed.ratios(square, solution.covariance))))
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
    """Change (N, 2) of the predictions with the points re-adjusted (eliminated)."""
    weighted = by_point * weights[:, None, None]
    own, right = np.zeros((len(ties), 3, 3)), np.zeros((len(ties), 3))
    np.add.at(own, ties.point, np.einsum("nai,naj->nij", weighted, by_point))
    np.add.at(right, ties.point, np.einsum("nai,na->ni", weighted, change))
    step = np.einsum("mij,mj->mi", np.linalg.pinv(own, hermitian=True), right)
    return change - np.einsum("nai,ni->na", by_point, step[ties.point])


def _footprint(problem: Problem, state: State, sizes: Sizes) -> float:
    """Footprint of the longer side of a photograph on the ground [m], with straight rays."""
    ties, layout = problem.ties, problem.layout
    distance = np.linalg.norm(state.points[ties.point] - state.centres[ties.view], axis=1)
    longer = np.array([max(size) for size in sizes], dtype=np.float64)
    return float(np.median(distance * (longer / state.lenses[layout.lens_of, 0])[ties.view]))


def _padded(starts: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Column indices of a sparse matrix, its rows filled up with zeros, and which are those of the matrix."""
    count = np.diff(starts)
    inside = np.arange(count.max(initial=0)) < count[:, None]
    found = np.zeros(inside.shape, dtype=np.int64)
    found[inside] = indices
    return found, inside


@dataclass(frozen=True)
class PredictionChanges:
    """Changes of the predicted observations by K changes of the parameters."""

    weights: np.ndarray  # (N,) [1/px^2]
    residuals: np.ndarray  # (N, 2) [px]
    changes: np.ndarray  # (N, 2, K) [px]
    design: csr_array  # (2 N, P)

    def ratios(self, square: np.ndarray, covariance: np.ndarray) -> np.ndarray:
        """Ratios (K,) of the squared sums over squares of ground to their expectation for independent errors.

        Parameters
        ----------
        square : (N,) int64
            Number of the square of each observation.
        covariance : (P, P)
            Of the parameters; of it, what belongs to the photographs of one square.
        """
        weighted = self.weights[:, None, None] * self.changes
        products = np.einsum("nak,na->nk", weighted, self.residuals)
        total = np.einsum("nak,nak->k", weighted, self.changes)
        rows = np.repeat(square, 2)
        of_squares = (square.max() + 1, len(rows))
        sums, left = np.zeros((of_squares[0], len(total))), total.copy()
        np.add.at(sums, square, products)
        by_rows = weighted.reshape(len(rows), -1).T
        taken = [csr_array((each, (rows, np.arange(len(rows)))), of_squares) @ self.design for each in by_rows]
        # Products leave out sums that are zero, and so differ in what they store.
        ones = csr_array((np.ones(self.design.nnz), self.design.indices, self.design.indptr), self.design.shape)
        stored = csr_array((np.ones(len(rows)), (rows, np.arange(len(rows)))), of_squares) @ ones
        columns, inside = _padded(stored.indptr, stored.indices)
        for first in range(0, len(columns), _AT_A_TIME):
            part = slice(first, first + _AT_A_TIME)
            at = columns[part]
            design = np.stack([np.take_along_axis(each[part].toarray(), at, axis=1) for each in taken]) * inside[part]
            followed = np.einsum("ksi,sij->ksj", design, covariance[at[:, :, None], at[:, None]])
            left -= np.einsum("ksi,ksi->k", followed, design)
        return np.sum(sums**2, axis=0) / np.maximum(left, 1e-12 * total + 1e-300)
