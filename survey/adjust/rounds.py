"""The rounds of an adjustment: outliers of observations, blunders of positions, correlated errors."""

from dataclasses import dataclass, replace

import numpy as np

from survey.adjust.block.bundle import NotConvergedError, Solution, solve
from survey.adjust.block.control_check import checked_points, stated_points
from survey.adjust.block.normal_equations import System, system_with
from survey.adjust.block.observed import KINDS, MARK, Observed, Sizes
from survey.adjust.block.on_ground import GroundTies, ties_on_ground
from survey.adjust.block.pose_std import agreeing_positions, positions_left_out, reestimate_pose_std, with_positions
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import State
from survey.adjust.clusters import cluster_design_effect, terrain_design_effect

# Observations of more standard deviations than this are left out.
_OUTLIER = 4.0
_ROUNDS = 4
# Wet observations of each kind are divided into that many strata of equal number by depth.
_STRATA = 3
# Under this share of observations left out in a round, there are no more outliers to find.
_FEW = 0.002
# The water is raised by so many standard deviations, so often at most.
_RAISED, _MOST_STEPS = 2.0, 6
# The level is as uncertain as it was, to this share.
_STEADY = 0.1
# Planes under the points of a block are found anew so often at most, until it moves by less than this share of their
# standard deviation.
_MOST_PLANES, _STEADY_ON_GROUND = 8, 0.05


def covariance_over_shore(problem: Problem, solution: Solution) -> np.ndarray:
    """Covariance (P, P) of the parameters with a free level, where points near it may be wet or dry.

    The derivative of the rays of a point by the level jumps at the surface. Points just above the estimated level
    have none, and seem to determine it together with the wet ones; at a slightly higher level they would not.
    Over a bed that is all wet, photographs may determine the level to no better than a metre, and the adjustment ends
    where the first points come dry, with a standard deviation of centimetres. So the normal equations are taken with
    the water raised by two standard deviations, until these no longer grow.
    """
    state, widest = solution.state, solution.system
    std = std_over_points(widest, solution.covariance)
    for _ in range(_MOST_STEPS):
        raised = state.with_level(state.require_water().point[2] + _RAISED * std)
        system = system_with(problem, raised, solution.weights)
        before, std = std, std_over_points(system)
        if std <= (1.0 + _STEADY) * before:
            break
        widest = system
    return solution.covariance if widest is solution.system else widest.normal.inverse


def std_over_points(system: System, covariance: np.ndarray | None = None) -> float:
    """Standard deviation [m] of the mean height of the water over the points, by a covariance (P, P) if given."""
    depth = -system.heights_by_parameters()
    depth[0] += 1.0
    following = system.normal.factor().solve(depth) if covariance is None else covariance @ depth
    return float(np.sqrt(depth @ following))


@dataclass(frozen=True)
class RobustSolution:
    """Solution of a block after the rounds that leave out outliers."""

    prior: PriorKnowledge  # With the standard deviations of poses that the block showed
    used: Observed  # What was not left out
    solution: Solution
    # Of the solution, with the standard deviations of its kinds, which are those of `used` divided by depth
    problem: Problem
    variance_factor: np.ndarray  # (N,): for what neighbouring observations and neighbouring ground share
    blunders: np.ndarray  # (V, 2) bool: positions and rotations that the block contradicts and that were left out
    on_ground: GroundTies | None = None  # The ground of an earlier survey under its tie points


def adjust(prior: PriorKnowledge, seen: Observed) -> RobustSolution:
    """Adjust a block from what is known, and again without outliers until none is left."""
    if not len(seen.kind):
        raise NotConvergedError("no tie point is left that three photographs show; the poses may be far off")
    state = replace(prior.state, points=seen.ties.start)
    left_out = positions_left_out(prior)
    blunders = np.column_stack([left_out, np.zeros_like(left_out)])
    factors = np.ones(len(KINDS) * (1 + _STRATA))
    given = np.tile(seen.given_std_px, 1 + _STRATA)
    coordinates, remaining = stated_points(seen), _ROUNDS
    asked_again = np.zeros_like(left_out)
    most = _ROUNDS + len(coordinates)
    while True:
        kind = _by_depth(seen, state)
        problem, solution, on_ground = _solve_once(prior, seen, state, kind, given, factors[kind])
        found = solution.std_px
        before, factors = factors, _factors(problem, solution, seen.sizes, factors)
        known_prior, known_blunders = prior, blunders
        prior, blunders = reestimate_pose_std(prior, solution, blunders)
        checked = checked_points(problem, solution, seen, coordinates)
        control_changed = checked is not seen
        # Wrong points are found one by one.
        most -= 1
        remaining = min(remaining - (not control_changed), most)
        keep = np.linalg.norm(solution.residuals, axis=1) < _OUTLIER * found[kind]
        # A wrong position or point biases poses, so that good observations there and nearby seem to be outliers.
        if (blunders & ~known_blunders).any() or control_changed:
            keep = np.ones_like(keep)
        kept = checked.only(keep)
        # A few matches do no harm at their Huber weights; a mark is one of few, and has a name.
        few = (~keep).mean() < _FEW and keep[seen.kind == MARK].all()
        converged = (
            few and prior is known_prior and not control_changed and (np.abs(factors / before - 1.0) < 0.2).all()
        )
        # What is returned as used is what the solution was found from.
        if converged or not remaining:
            agree = agreeing_positions(prior, solution) & ~asked_again
            if not agree.any():
                break
            prior, asked_again, remaining, most = with_positions(prior, agree), asked_again | agree, _ROUNDS, _ROUNDS
            blunders[agree, 0] = False
        state = replace(solution.state, points=seen.at(solution.state.points).only(keep).ties.start)
        seen = kept.at(state.points)
        # The covariance of 2,000 photographs takes 1.2 GB.
        del problem, solution, on_ground
    if prior.common_up_std > 0.0:
        solution = replace(solution, covariance=covariance_over_shore(problem, solution))
    solution = replace(solution, std_px=np.sqrt(mean_by_kind(found[kind] ** 2, seen.kind)))
    problem = replace(problem, given_std_px=found)
    return RobustSolution(prior, seen, solution, problem, factors[kind], blunders, on_ground)


def _solve_once(
    prior: PriorKnowledge,
    seen: Observed,
    state: State,
    kind: np.ndarray,
    given: np.ndarray,
    variance_factor: np.ndarray,
) -> tuple[Problem, Solution, GroundTies | None]:
    """Adjust once; on ground, until the planes under the points no longer change."""
    problem, on_ground = replace(seen.problem(prior, state), kind=kind, given_std_px=given), None
    for _ in range(1 if seen.ground is None else _MOST_PLANES):
        if seen.ground is not None:
            on_ground = ties_on_ground(seen.ground, state.points - state.shift, len(seen.ties) - len(seen.control))
        planes = None if on_ground is None else on_ground.planes
        problem = replace(problem, priors=replace(problem.priors, planes=planes))
        solution = solve(problem, state, variance_factor=variance_factor)
        before, state = state, solution.state
        if planes is not None:
            used = planes.precision > 0.0
            moved = state.points[used] - state.shift - before.points[used] + before.shift
            moves = np.abs(np.median(moved, axis=0))
            if moves.max() <= _STEADY_ON_GROUND * float(np.median(planes.precision[used] ** -0.5)):
                break
    return problem, solution, on_ground


def _factors(problem: Problem, solution: Solution, sizes: Sizes, before: np.ndarray) -> np.ndarray:
    """Factors (kinds,) on variances, for correlated errors of neighbours; ``before``: those of the solution."""
    kind = problem.kind
    shared = cluster_design_effect(problem.ties, solution.residuals, solution.std_px, kind, sizes)
    is_tie = kind % len(KINDS) != MARK
    if is_tie.any():
        # Errors of the ground and those of one photograph cannot be separated: the larger design effect counts.
        lacking = terrain_design_effect(problem, solution, sizes, is_tie)
        shared *= max(1.0, lacking * float(np.mean((before[kind] / shared)[is_tie])))
    factors = np.array([shared[kind == number][0] if (kind == number).any() else 1.0 for number in range(len(before))])
    factors[MARK :: len(KINDS)] = 1.0
    return factors


def _by_depth(seen: Observed, state: State) -> np.ndarray:
    """Kinds (N,) of observations, those of wet ones divided by depth: waves displace deep points more."""
    kind = seen.kind.copy()
    if state.water is None:
        return kind
    depth = state.water.depth(state.points)[seen.ties.point]
    for number in range(len(KINDS)):
        wet = (seen.kind == number) & (depth > 0.0)
        if wet.any():
            edges = np.quantile(depth[wet], np.arange(1, _STRATA) / _STRATA)
            kind[wet] += len(KINDS) * (1 + np.searchsorted(edges, depth[wet]))
    return kind


def mean_by_kind(values: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Mean of values (N,) of each kind; NaN of those that do not occur."""
    count = np.bincount(kind, minlength=len(KINDS))
    return np.where(count > 0, np.bincount(kind, values, len(KINDS)) / np.maximum(count, 1), np.nan)
