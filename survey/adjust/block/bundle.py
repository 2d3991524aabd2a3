"""Bundle adjustment through the water: Levenberg-Marquardt on tie points and priors, the points eliminated.

M points, N observations (a point in a photograph), P parameters (`survey.adjust.block.state`)
r      residual, measured minus predicted pixel (N, 2)
X, B   derivatives of the prediction by its point (N, 2, 3) and by the parameters (2 N, P), sparse
w      weight of an observation (N,) [1/px^2]
V      normal matrix of each point (M, 3, 3), S that of the parameters with the points following (P, P)

The loss of observations is Huber's (`survey.adjust.block.problem`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import bsr_array, csr_array, diags_array, lil_array

from survey.adjust.block.normal_matrix import NormalMatrix
from survey.adjust.block.prediction import linearise
from survey.adjust.block.problem import HUBER, Problem, huber_loss, huber_weights, std_of_kinds
from survey.adjust.block.state import SHIFT, State
from survey.errors import SurveyError
from survey.photos.poses import TiePoints

_MOST_STEPS = 60
# A step that lowers the sum of squares by less, in units of variances, moves no parameter by more than a fifth of its
# standard deviation, and most by far less.
_DONE = 0.03
_SLACK = 1e-6
# Where a step gains less than this share of what the linear model predicts, points are adjusted, in so many steps.
_AS_PREDICTED, _POINT_STEPS = 0.5, 4
# Weights give an outlier the curvature of a square, which Huber's loss has not along its residual: where a step gains
# more than so many times what they predict, steps are taken with a share of that curvature alone (B. Triggs et al.,
# Bundle adjustment - a modern synthesis, 2000, section 4.3; the square of the share).
_AS_LINEAR, _CURVATURE = 1.5, 0.1
# Points whose height has more than so many times the median standard deviation are of uncertain height.
_WEAK = 3.0
# Weights are renewed from the residuals until the standard deviations of all kinds change by less than this share.
_STEADY, _MOST_ROUNDS = 0.02, 6
# Keeps the elimination finite for a point that its rays hardly determine. It holds points where they are, and with them
# the scale of a block: 1e-9 constrains it as strongly as positions of 0.2 m.
_DAMPING = 1e-13
_DAMPING_START, _DAMPING_LEAST, _DAMPING_MOST = 1e-6, 1e-12, 1e6


class NotConvergedError(SurveyError):
    """An adjustment that does not converge."""


@dataclass(frozen=True)
class System:
    """The normal equations at one state, points eliminated."""

    # normal, right_side (P, P), (P,): with the priors
    normal: NormalMatrix
    right_side: np.ndarray
    root: np.ndarray
    free: np.ndarray
    mixed: csr_array

    def predicted_decrease(self, step: np.ndarray) -> float:
        """Predicted decrease of the sum of squares by a step of parameters and points (linear model)."""
        return float(self.right_side @ step + np.sum(self.free**2))

    def decrement(self) -> float:
        """Predicted decrease of the sum of squares by the undamped step: the Newton decrement."""
        return self.predicted_decrease(self.normal.factor().solve(self.right_side))

    def heights_by_parameters(self) -> np.ndarray:
        """Derivative (P,) of the mean height of the points by the parameters, without those of uncertain height."""
        up = self.root[:, :, 2]
        std = np.linalg.norm(up, axis=1)
        # One point whose rays are nearly parallel would outweigh all others.
        used = std <= _WEAK * np.median(std)
        return -(self.mixed.T @ (up * used[:, None]).reshape(-1)) / used.sum()

    def point_steps(self, step: np.ndarray) -> np.ndarray:
        """Steps (M, 3) [m] of the points that go with a step of the parameters (P,)."""
        left = self.free - (self.mixed @ step).reshape(-1, 3)
        return np.einsum("mij,mi->mj", self.root, left)


@dataclass(frozen=True)
class Solution:
    """An adjusted block."""

    state: State
    covariance: np.ndarray  # (P, P): of the parameters, with errors of the observations as they are weighted
    residuals: np.ndarray  # (N, 2) [px]
    weights: np.ndarray  # (N,) [1/px^2]
    std_px: np.ndarray  # (kinds,) [px]: standard deviation of a pixel coordinate of each kind
    system: System


def solve(problem: Problem, start: State, *, inflation: np.ndarray | None = None) -> Solution:
    """Adjust a block.

    Parameters
    ----------
    inflation : (N,), optional
        Factor on the variance of each observation, for what neighbours share.

    Raises
    ------
    NotConvergedError
        If the adjustment does not converge, or nothing ties a photograph to the others.
    """
    try:
        return _solved(problem, start, inflation)
    except np.linalg.LinAlgError as error:
        raise NotConvergedError(
            "the adjustment is singular: a photograph has neither a position nor enough tie points with others; give "
            "it a position, or leave it out"
        ) from error


def _solved(problem: Problem, start: State, inflation: np.ndarray | None) -> Solution:
    inflation = np.ones(len(problem.kind)) if inflation is None else inflation
    std_px = std_of_kinds(problem, problem.residuals(start), 0.0)
    state, system = levenberg_marquardt(problem, start, std_px, inflation)
    for _ in range(_MOST_ROUNDS):
        # Each parameter takes one coordinate, less the share that its prior determines.
        taken = float(np.sum(1.0 - system.normal.factor().inverse_diagonal() / problem.priors.std**2))
        before, std_px = std_px, std_of_kinds(problem, problem.residuals(state), taken)
        if (np.abs(std_px / before - 1.0) < _STEADY).all():
            break
        state, system = levenberg_marquardt(problem, state, std_px, inflation)
    residuals = problem.residuals(state)
    weights = huber_weights(problem, residuals, std_px) / inflation
    return Solution(state, system.normal.inverse(), residuals, weights, std_px, system)


def covariance_at(problem: Problem, state: State, std_px: np.ndarray) -> np.ndarray:
    """Covariance (P, P) of the parameters at a state, for standard deviations (kinds,) [px] of the observations."""
    return system_at(problem, state, std_px).normal.inverse()


def system_at(problem: Problem, state: State, std_px: np.ndarray) -> System:
    """The normal equations at a state, for standard deviations (kinds,) [px] of the observations."""
    return _system(problem, state, std_px, np.ones(len(problem.kind)))


def system_with(problem: Problem, state: State, weights: np.ndarray) -> System:
    """The normal equations at a state, for weights (N,) [1/px^2] of the observations."""
    return _weighted_system(problem, state, lambda _residuals: weights)


def levenberg_marquardt(problem: Problem, state: State, std_px, inflation) -> tuple[State, System]:
    """The state of least cost for given standard deviations, and its normal equations."""
    damping, least, is_linear = _DAMPING_START, cost(problem, state, std_px, inflation), False
    for _ in range(_MOST_STEPS):
        system = _system(problem, state, std_px, inflation, is_linear=is_linear)
        while True:
            step = system.normal.factor(damping).solve(system.right_side)
            moved = state.moved(problem.layout, step, system.point_steps(step))
            costs, predicted = cost(problem, moved, std_px, inflation), system.predicted_decrease(step)
            if predicted >= _DONE and not costs < least - _AS_PREDICTED * predicted:
                moved, costs = _with_points(problem, moved, state.points, std_px, inflation)
            # At the shoreline, where rays begin to bend, the linear model may predict a decrease that is not reached.
            if costs < least + _SLACK * least or predicted < _DONE:
                break
            damping *= 10.0
            if damping > _DAMPING_MOST:
                return state, _system(problem, state, std_px, inflation)
        gain = least - costs if costs < least else 0.0
        if gain > max(_AS_LINEAR * predicted, _DONE) or gain < _AS_PREDICTED * predicted:
            is_linear = gain > predicted
        if gain > 0.0:
            state, least = moved, costs
        damping = max(damping * 0.1, _DAMPING_LEAST)
        if gain < _DONE:
            system = _system(problem, state, std_px, inflation, is_linear=is_linear)
            # A damped step that gains little may still be far from the minimum, along a direction of small curvature.
            if gain == 0.0 or system.decrement() < _DONE:
                break
    if gain < _DONE:
        return state, _system(problem, state, std_px, inflation) if is_linear else system
    raise NotConvergedError(
        f"the adjustment did not converge in {_MOST_STEPS} steps: poses and photographs do not belong together, or "
        "the photographs hardly overlap"
    )


def _with_points(
    problem: Problem, state: State, before: np.ndarray, std_px: np.ndarray, inflation: np.ndarray
) -> tuple[State, float]:
    """The state with its points adjusted under its parameters, and what it costs.

    Depth and level of the water are coupled: along a step of both, points that move in a straight line leave the bottom
    of a curved valley. Embedded point iterations follow it (Y. Jeong et al., Pushing the envelope of modern methods for
    bundle adjustment, IEEE TPAMI 34, 2012). Each point is accepted by itself, beginning with its place (M, 3) before
    the step: one whose rays are nearly parallel may be sent far along them.
    """
    held, none = replace(problem, holds_parameters=True), np.zeros(len(problem.priors.std))
    costs = _costs_of_points(problem, state, std_px, inflation)
    moved = replace(state, points=before)
    for step in range(1 + _POINT_STEPS):
        costs_of_moved = _costs_of_points(problem, moved, std_px, inflation)
        better = costs_of_moved < costs
        if step and not better.any():
            break
        state = replace(state, points=np.where(better[:, None], moved.points, state.points))
        costs = np.where(better, costs_of_moved, costs)
        moved = replace(state, points=state.points + _system(held, state, std_px, inflation).point_steps(none))
    return state, float(costs.sum() + problem.priors.squares(problem.layout, state))


def cost(problem: Problem, state: State, std_px: np.ndarray, inflation: np.ndarray | float = 1.0) -> float:
    """Cost function: Huber losses of residuals and squared deviations from priors, in units of variances.

    Parameters
    ----------
    std_px : (kinds,) [px]
        Of the observations.
    inflation : (N,), optional
        As for `solve`.
    """
    of_points = _costs_of_points(problem, state, std_px, inflation)
    return float(of_points.sum() + problem.priors.squares(problem.layout, state))


def _costs_of_points(
    problem: Problem, state: State, std_px: np.ndarray, inflation: np.ndarray | float = 1.0
) -> np.ndarray:
    """The part (M,) of the cost function that each point has."""
    residuals = problem.residuals(state)
    length = np.linalg.norm(residuals, axis=1) / std_px[problem.kind]
    # A point that went behind a camera costs more than any that did not.
    length = np.where(np.isfinite(length), length, 1e6)
    huber = np.bincount(problem.ties.point, huber_loss(length) / inflation, len(problem.ties))
    known = (state.points - problem.priors.state.points) / problem.priors.point_std
    planes = problem.priors.planes
    if planes is not None:
        huber += planes.squares(state.points, state.shift)
    return huber + np.sum(known**2, axis=1)


def _system(
    problem: Problem, state: State, std_px: np.ndarray, inflation: np.ndarray, *, is_linear: bool = False
) -> System:
    """The normal equations with Huber weights; ``is_linear``: for steps where the loss is nearly linear."""

    def weights_of(residuals: np.ndarray) -> np.ndarray:
        return huber_weights(problem, residuals, std_px) / inflation

    def outliers(residuals: np.ndarray) -> np.ndarray:
        return np.linalg.norm(residuals, axis=1) > HUBER * std_px[problem.kind]

    return _weighted_system(problem, state, weights_of, outliers if is_linear else None)


def _weighted_system(
    problem: Problem,
    state: State,
    weights_of: Callable[[np.ndarray], np.ndarray],
    outliers: Callable[[np.ndarray], np.ndarray] | None = None,
) -> System:
    """The normal equations.

    Parameters
    ----------
    weights_of : callable
        Takes residuals (N, 2) [px] to weights (N,) [1/px^2].
    outliers : callable, optional
        Takes them to those whose curvature along the residual is reduced, (N,) bool.
    """
    linear, priors = _linearised(problem, state, weights_of, outliers), problem.priors
    planes = None if priors.planes is None else priors.planes.of_points(state.points, state.shift)
    own, right = _of_points(problem, state, linear, planes)
    root = np.linalg.inv(np.linalg.cholesky(_damped(own)))
    free = np.einsum("mij,mj->mi", root, right)
    strength = np.where(np.isfinite(priors.std), priors.std, np.inf) ** -2.0
    if problem.holds_parameters:
        fixed = csr_array((free.size, len(strength)))
        return System(NormalMatrix.of(diags_array(strength)), np.zeros(len(strength)), root, free, fixed)
    mixed = _mixed(problem, linear, root, planes)
    whole = csr_array(linear.design.multiply(np.repeat(linear.weights, 2)[:, None]))
    normal = linear.design.T @ whole - mixed.T @ mixed + diags_array(strength)
    deviation = priors.deviation(problem.layout, state)
    gradient = whole.T @ linear.residuals.ravel() - mixed.T @ free.ravel() - strength * deviation
    if planes is not None:
        shift, (on_plane, to_plane) = problem.layout.shift, planes
        normal = normal + _in_block(on_plane.sum(axis=0), shift, len(strength))
        gradient[shift] -= to_plane.sum(axis=0)
    found = NormalMatrix.of(normal, problem.order)
    if priors.rows is not None and priors.signs is not None:
        found = found.with_rows(priors.rows, priors.signs)
        gradient -= priors.rows.T @ (priors.signs * (priors.rows @ deviation))
    return System(found, gradient, root, free, mixed)


@dataclass(frozen=True)
class _Linearised:
    """Observations linearised at a state, with their weights."""

    residuals: np.ndarray  # (N, 2) [px]
    weights: np.ndarray  # (N,) [1/px^2]
    by_point: np.ndarray  # (N, 2, 3): X
    weighted: np.ndarray  # (N, 2, 3): w X
    design: csr_array  # (2 N, P): B


def _linearised(
    problem: Problem,
    state: State,
    weights_of: Callable[[np.ndarray], np.ndarray],
    outliers: Callable[[np.ndarray], np.ndarray] | None,
) -> _Linearised:
    """The observations at a state; those of weight 0 have no derivatives."""
    linear = linearise(problem.layout, state, problem.ties, problem.sides, problem.rows)
    residuals = problem.ties.pixel - linear.pixels
    weights = weights_of(residuals)
    usable = weights > 0.0
    residuals = np.where(usable[:, None], residuals, 0.0)
    by_point = np.where(usable[:, None, None], linear.by_point, 0.0)
    design = linear.by_parameters
    if not usable.all():
        design = _only_rows(design, usable)
    if outliers is not None:
        is_outlier = usable & outliers(residuals)
        along = residuals / np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-300)
        reduced = np.eye(2) - (1.0 - _CURVATURE) * is_outlier[:, None, None] * along[:, :, None] * along[:, None, :]
        # The gradient stays as it is.
        residuals = np.where(is_outlier[:, None], residuals / _CURVATURE, residuals)
        by_point = reduced @ by_point
        values = reduced @ design.data.reshape(len(residuals), 2, -1)
        design = csr_array((values.ravel(), design.indices, design.indptr), shape=design.shape)
    return _Linearised(residuals, weights, by_point, by_point * weights[:, None, None], design)


def _of_points(
    problem: Problem, state: State, linear: _Linearised, planes: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrices (M, 3, 3) and right sides (M, 3) of the points alone; ``planes`` as of `Planes.of_points`."""
    precision = problem.priors.point_std**-2.0
    own = _sum(problem.ties, np.einsum("nai,naj->nij", linear.weighted, linear.by_point))
    own[:, range(3), range(3)] += precision
    right = _sum(problem.ties, np.einsum("nai,na->ni", linear.weighted, linear.residuals))
    right = right - precision * np.nan_to_num(state.points - problem.priors.state.points)
    return (own, right) if planes is None else (own + planes[0], right + planes[1])


def _mixed(
    problem: Problem, linear: _Linearised, root: np.ndarray, planes: tuple[np.ndarray, np.ndarray] | None
) -> csr_array:
    """Mixed matrix (3 M, P) of points and parameters, with the root of the points' own matrices as left factor.

    With that factor, the elimination is one product.
    """
    ties = problem.ties
    rooted = np.einsum("nij,naj->nia", root[ties.point], linear.weighted)
    starts = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    left = bsr_array((rooted, np.arange(len(ties.view)), starts), shape=(3 * len(ties), 2 * len(ties.view)))
    mixed = csr_array(left.tocsr() @ linear.design)
    if planes is None:
        return mixed
    return mixed + _in_columns(-(root @ planes[0]).reshape(-1, SHIFT), problem.layout.shift, mixed.shape)


def _only_rows(design: csr_array, keep: np.ndarray) -> csr_array:
    """A sparse matrix (2 N, P) with rows of zeros for the observations that are not kept, (N,) bool."""
    values = design.data.reshape(2 * len(keep), -1)
    values = np.where(np.repeat(keep, 2)[:, None], np.nan_to_num(values), 0.0)
    return csr_array((values.ravel(), design.indices, design.indptr), shape=design.shape)


def _in_columns(values: np.ndarray, columns: slice, shape: tuple[int, int]) -> csr_array:
    """Values (rows, K) in K of the columns of a sparse matrix of zeros."""
    rows, count = values.shape
    where = np.tile(np.arange(columns.start, columns.stop), rows)
    return csr_array((values.ravel(), where, count * np.arange(rows + 1)), shape=shape)


def _in_block(values: np.ndarray, at: slice, size: int) -> csr_array:
    """Values (K, K) on the diagonal of a sparse matrix of zeros, (size, size)."""
    found = lil_array((size, size))
    found[at, at] = values
    return csr_array(found)


def _sum(ties: TiePoints, values: np.ndarray) -> np.ndarray:
    """Sums over the observations of each point, (M, ...)."""
    first = np.searchsorted(ties.point, np.arange(len(ties)))
    return np.add.reduceat(values, first, axis=0)


def _damped(normal: np.ndarray) -> np.ndarray:
    """Matrices (M, 3, 3), damped enough to be inverted."""
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return normal + (_DAMPING * scale + 1e-300) * np.eye(3)
