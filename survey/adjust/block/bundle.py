"""Bundle adjustment through the water: Levenberg-Marquardt on tie points and priors, the points eliminated.

M points, N observations (a point in a photograph), P parameters (`survey.adjust.block.state`)
r      residual, measured minus predicted pixel (N, 2)
X, B   derivatives of the prediction by its point (N, 2, 3) and by the parameters (2 N, P), sparse
w      weight of an observation (N,) [1/px^2]
V      normal matrix of each point (M, 3, 3), S that of the parameters with the points following (P, P)

The loss of observations is Huber's (`survey.adjust.block.problem`).
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from survey.adjust.block.normal_equations import System, huber_system, system_with
from survey.adjust.block.problem import Problem, huber_loss, huber_weights, std_of_kinds
from survey.adjust.block.state import State
from survey.errors import SurveyError

_MOST_STEPS = 60
# A step that lowers the sum of squares by less, in units of variances, moves no parameter by more than a fifth of its
# standard deviation, and most by far less.
_DONE = 0.03
_SLACK = 1e-6
# Where a step gains less than this share of what the linear model predicts, points are adjusted, in so many steps.
_AS_PREDICTED, _POINT_STEPS = 0.5, 4
# Weights are renewed from the residuals until the standard deviations of all kinds change by less than this share.
_STEADY, _MOST_ROUNDS = 0.01, 6
# A step that lowers the cost to more than the first share of it has them renewed, and until they then change by less
# than the second one no minimum is looked for.
_LOWERED, _NEARLY_STEADY = 0.5, 0.05
# The cost may fall by so many times what the linear model predicts.
_IN_SIGHT = 3.0
# Advice in errors.
_ADVICE = "poses and photographs do not belong together, or the photographs hardly overlap"
_DAMPING_START, _DAMPING_LEAST, _DAMPING_MOST = 1e-6, 1e-12, 1e6


class NotConvergedError(SurveyError):
    """An adjustment that does not converge."""


@dataclass(frozen=True)
class Solution:
    """Minimum of one problem."""

    state: State
    covariance: np.ndarray  # (P, P): of the parameters, with errors of the observations as they are weighted
    residuals: np.ndarray  # (N, 2) [px]
    weights: np.ndarray  # (N,) [1/px^2]
    std_px: np.ndarray  # (kinds,) [px]: standard deviation of a pixel coordinate of each kind
    system: System  # At the state, with the weights


def solve(problem: Problem, start: State, *, variance_factor: np.ndarray | None = None) -> Solution:
    """Adjust a block, with a factor (N,) on the variance of each observation, for what neighbours share."""
    try:
        return _solved(problem, start, variance_factor)
    except np.linalg.LinAlgError as error:
        raise NotConvergedError(
            "the adjustment is singular: a photograph has neither a position nor enough tie points with others; give "
            "it a position, or leave it out"
        ) from error


def _solved(problem: Problem, start: State, variance_factor: np.ndarray | None) -> Solution:
    variance_factor = np.ones(len(problem.kind)) if variance_factor is None else variance_factor
    state, std_px = _near_minimum(problem, start, variance_factor)
    for _ in range(_MOST_ROUNDS):
        state, system = levenberg_marquardt(problem, state, std_px, variance_factor)
        residuals = problem.residuals(state)
        before, std_px = std_px, std_of_kinds(problem, residuals, _taken(problem, system))
        if (np.abs(std_px / before - 1.0) < _STEADY).all():
            break
    weights = huber_weights(problem, residuals, std_px) / variance_factor
    # Where a prior hardly holds the block as a whole, a step turns the directions in which it is free: the covariance
    # before the last one is none of derivatives after it.
    system = system_with(problem, state, weights)
    return Solution(state, system.normal.inverse, residuals, weights, std_px, system)


def _near_minimum(problem: Problem, start: State, variance_factor: np.ndarray) -> tuple[State, np.ndarray]:
    """A state near the minimum, and standard deviations (kinds,) [px] of the observations there.

    These fall with the residuals, which at a start are far larger: as soon as a step no longer halves the cost, a
    minimum for them is not worth while.
    """
    std_px = std_of_kinds(problem, problem.residuals(start), 0.0)
    at = _Iterate(start, cost(problem, start, std_px, variance_factor), _DAMPING_START)
    for _ in range(_MOST_STEPS):
        system = huber_system(problem, at.state, std_px, variance_factor)
        moved = _try_step(problem, at, system, std_px, variance_factor)
        if moved is None:
            break
        before, at = at.cost, replace(moved, damping=max(moved.damping * 0.1, _DAMPING_START))
        if at.cost < _LOWERED * before:
            continue
        renewed = std_of_kinds(problem, problem.residuals(at.state), 0.0)
        is_steady = bool((np.abs(renewed / std_px - 1.0) < _NEARLY_STEADY).all())
        std_px, at = renewed, replace(at, cost=cost(problem, at.state, renewed, variance_factor))
        if is_steady:
            break
    return at.state, std_of_kinds(problem, problem.residuals(at.state), _taken(problem, system))


def _taken(problem: Problem, system: System) -> float:
    """How many coordinates the parameters take: each takes one, less the share that its prior determines.

    With the covariance C and the normal matrix W of the priors that is the trace of ``1 - C W``.
    """
    priors, taken = problem.priors, np.sum(1.0 - system.normal.inverse_diagonal() / problem.priors.std**2)
    if len(priors.signs):
        taken -= priors.signs @ np.sum(priors.rows * system.normal.factor().solve(priors.rows.T).T, axis=1)
    return float(taken)


def levenberg_marquardt(
    problem: Problem, state: State, std_px, variance_factor, *, below: float = math.inf
) -> tuple[State, System]:
    """The state of least cost for given standard deviations, and normal equations no further than a last step from it.

    Raises NotConvergedError, also as soon as no minimum ``below`` a cost is in sight.
    """
    # Where the decrement is asked for at each step, its factor serves that one, too.
    first, least = (_DAMPING_START, _DAMPING_LEAST) if below == math.inf else (0.0, 0.0)
    at = _Iterate(state, cost(problem, state, std_px, variance_factor), first)
    for _ in range(_MOST_STEPS):
        system = huber_system(problem, at.state, std_px, variance_factor)
        if below < math.inf and at.cost - _IN_SIGHT * system.decrement() > below:
            raise NotConvergedError(f"the adjustment does not come below a sum of squares of {below:.6g}")
        moved = _try_step(problem, at, system, std_px, variance_factor)
        if moved is None:
            _require_minimum(problem, at.cost, system.decrement())
            return at.state, system
        gain = max(at.cost - moved.cost, 0.0)
        at = replace(moved if gain > 0.0 else at, damping=max(moved.damping * 0.1, least))
        # A damped step that gains little may still be far from the minimum, along a direction of small curvature.
        if gain < _DONE and (gain == 0.0 or system.decrement() < _DONE):
            return at.state, system
    raise NotConvergedError(f"the adjustment did not converge in {_MOST_STEPS} steps: {_ADVICE}")


@dataclass(frozen=True)
class _Iterate:
    state: State
    cost: float
    damping: float  # Of the step that led there, or of the first trial of the next one


def _try_step(
    problem: Problem, at: _Iterate, system: System, std_px: np.ndarray, variance_factor: np.ndarray
) -> _Iterate | None:
    """The first step, by rising damping, that does not raise the cost.

    A rise by `_SLACK` is none: at the shoreline, where rays begin to bend, the linear model may predict a decrease that
    is not reached. None where every damping raises the cost.
    """
    damping = at.damping
    while damping <= _DAMPING_MOST:
        step = system.normal.factor(damping).solve(system.right_side)
        moved = at.state.moved(problem.layout, step, system.point_steps(step))
        costs, predicted = cost(problem, moved, std_px, variance_factor), system.predicted_decrease(step)
        if predicted >= _DONE and not costs < at.cost - _AS_PREDICTED * predicted:
            moved, costs = with_points(problem, moved, at.state.points, std_px, variance_factor)
        if costs < at.cost + _SLACK * at.cost or predicted < _DONE:
            return _Iterate(moved, costs, damping)
        damping = max(10.0 * damping, _DAMPING_LEAST)
    return None


def rounding_of_cost(problem: Problem, value: float) -> float:
    """Bound on the rounding error of the cost function at a value, as a sum of squares and losses in float64.

    A sum of n terms that are not negative is exact to n machine epsilons of itself, whatever the order (N. J. Higham,
    Accuracy and stability of numerical algorithms, 2002, section 4.2).
    """
    num_terms = 2 * len(problem.kind) + 3 * len(problem.ties) + len(problem.layout)
    return num_terms * float(np.finfo(np.float64).eps) * value


def _require_minimum(problem: Problem, value: float, decrement: float) -> None:
    """Raise where the Newton decrement of a state whose cost no step lowers is more than rounding explains."""
    bound = rounding_of_cost(problem, value)
    # Less than the bound is the minimum: such a decrease would not show in the cost.
    if not decrement <= bound:
        raise NotConvergedError(
            f"the adjustment did not converge: no step lowers the sum of squares of {value:.6g}, though the normal "
            f"equations predict {decrement:.3g} less and rounding explains {bound:.1g}: {_ADVICE}"
        )


def with_points(
    problem: Problem, state: State, before: np.ndarray, std_px: np.ndarray, variance_factor: np.ndarray
) -> tuple[State, float]:
    """The state with its points adjusted under its parameters, and what it costs.

    Depth and level of the water are coupled: along a step of both, points that move in a straight line leave the bottom
    of a curved valley. Embedded point iterations follow it (Y. Jeong et al., Pushing the envelope of modern methods for
    bundle adjustment, IEEE TPAMI 34, 2012). Each point is accepted by itself, beginning with its place (M, 3) before
    the step: one whose rays are nearly parallel may be sent far along them.
    """
    held, no_step = replace(problem, holds_parameters=True), np.zeros(len(problem.priors.std))
    costs = _costs_of_points(problem, state, std_px, variance_factor)
    costs_before = _costs_of_points(problem, replace(state, points=before), std_px, variance_factor)
    points = np.where((costs_before < costs)[:, None], before, state.points)
    costs = np.minimum(costs, costs_before)
    active = np.arange(len(points))
    for _ in range(_POINT_STEPS):
        part = held.of_points(active)
        factor = variance_factor[problem.observations_of(active)]
        at = replace(state, points=points[active])
        steps = huber_system(part, at, std_px, factor).point_steps(no_step)
        moved = replace(at, points=at.points + steps)
        gain = costs[active] - _costs_of_points(part, moved, std_px, factor)
        lower = gain > 0.0
        points[active[lower]] = moved.points[lower]
        costs[active[lower]] -= gain[lower]
        # Steps converge quadratically: points that gained less than their share of `_DONE` have nothing left to gain.
        active = active[gain > _DONE / len(points)]
        if not len(active):
            break
    return replace(state, points=points), float(costs.sum() + problem.priors.squares(problem.layout, state))


def cost(problem: Problem, state: State, std_px: np.ndarray, variance_factor: np.ndarray | float = 1.0) -> float:
    """Cost function: Huber losses of residuals and squared deviations from priors, in units of variances."""
    of_points = _costs_of_points(problem, state, std_px, variance_factor)
    return float(of_points.sum() + problem.priors.squares(problem.layout, state))


def _costs_of_points(
    problem: Problem, state: State, std_px: np.ndarray, variance_factor: np.ndarray | float = 1.0
) -> np.ndarray:
    """The part (M,) of the cost function that each point has."""
    residuals = problem.residuals(state)
    length = np.linalg.norm(residuals, axis=1) / std_px[problem.kind]
    # A point that went behind a camera costs more than any that did not.
    length = np.where(np.isfinite(length), length, 1e6)
    huber = np.bincount(problem.ties.point, huber_loss(length) / variance_factor, len(problem.ties))
    known = (state.points - problem.priors.state.points) / problem.priors.point_std
    planes = problem.priors.planes
    if planes is not None:
        huber += planes.squares(state.points, state.shift)
    return huber + np.sum(known**2, axis=1)
