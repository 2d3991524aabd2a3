"""The rounds of an adjustment: outliers of observations, blunders of positions, correlated errors."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from survey.adjust.bundle import NotConvergedError, Problem, Solution, solve
from survey.adjust.clusters import inflation
from survey.adjust.control_check import checked_points, given_points
from survey.adjust.ground_clusters import shared_by_ground
from survey.adjust.observed import KINDS, MARK, Observed, rows_taken
from survey.adjust.pose_std import judged
from survey.adjust.prediction import relief_sides
from survey.adjust.priors import Known, priors_for
from survey.adjust.shore_side import covariance_over_shore
from survey.adjust.state import State

# Observations of more standard deviations than this are left out.
_OUTLIER = 4.0
_ROUNDS = 4
# Wet observations of each kind are divided into that many strata of equal number by depth.
_STRATA = 3
# Under this share of observations left out in a round, there are no more outliers to find.
_FEW = 0.002


@dataclass(frozen=True)
class Adjusted:
    """A block after its adjustment.

    Attributes
    ----------
    known : Known
        With the standard deviations of poses that the block showed.
    used : Observed
        What was not left out.
    solution : Solution
    factor : (kinds,)
        On variances, for what neighbouring observations and neighbouring ground share.
    blunders : (V, 2) bool
        Positions and rotations that the block contradicts and that were left out.
    """

    known: Known
    used: Observed
    solution: Solution
    factor: np.ndarray
    blunders: np.ndarray


def adjust(known: Known, seen: Observed, sizes, marks_std_px: float) -> Adjusted:
    """Adjust a block, and again without outliers until none is left.

    Parameters
    ----------
    known : Known
    seen : Observed
    sizes : (width, height) [px] of each photograph
    marks_std_px : float

    Raises
    ------
    NotConvergedError
        If an adjustment does not converge.
    """
    if not len(seen.kind):
        raise NotConvergedError("no window or match is left in three photographs to adjust")
    state = replace(known.state, points=seen.ties.start)
    blunders = np.zeros((len(known.unknown_positions), 2), dtype=bool)
    factors = np.ones(len(KINDS) * (1 + _STRATA))
    given = np.full(len(factors), np.nan)
    given[MARK :: len(KINDS)] = marks_std_px
    coordinates, remaining = given_points(seen), _ROUNDS
    most = _ROUNDS + len(coordinates)
    while True:
        priors, sides = priors_for(known, seen.ties, seen.point_std), relief_sides(state, seen.ties)
        kind = _by_depth(seen, state)
        rows = rows_taken(seen.ties, known.lenses, known.layout.lens_of)
        problem = Problem(known.layout, seen.ties, kind, priors, given, sides, rows)
        solution = solve(problem, state, inflation=factors[kind])
        found = solution.std_px
        before, factors = factors, _factors(problem, solution, sizes, factors)
        poses, known_blunders = judged(known, solution, blunders), blunders
        known, blunders = poses.known, poses.blunders
        checked = checked_points(problem, solution, seen, coordinates)
        control_changed = checked is not seen
        # Wrong points are found one by one.
        most -= 1
        remaining = min(remaining - (not control_changed), most)
        keep = np.linalg.norm(solution.residuals, axis=1) < _OUTLIER * found[kind]
        # A wrong position or point pulls photographs away from all that they show, and neighbours with them.
        if (blunders & ~known_blunders).any() or control_changed:
            keep = np.ones_like(keep)
        kept = checked.only(keep)
        # A few matches do no harm at their Huber weights; a mark is one of few, and has a name.
        few = (~keep).mean() < _FEW and keep[seen.kind == MARK].all()
        settled = few and not poses.is_changed and not control_changed and (np.abs(factors / before - 1.0) < 0.2).all()
        # What is returned as used is what the solution was found from.
        if settled or not remaining:
            break
        state = _without_points(solution.state, seen, keep)
        seen = kept.at(state.points)
    if known.common_up_std > 0.0:
        solution = replace(solution, covariance=covariance_over_shore(problem, solution))
    solution = replace(solution, std_px=np.sqrt(_means(found[kind] ** 2, seen.kind)))
    return Adjusted(known, seen, solution, _means(factors[kind], seen.kind), blunders)


def _factors(problem: Problem, solution: Solution, sizes, before: np.ndarray) -> np.ndarray:
    """Factors (kinds,) on variances, for what neighbours share; ``before`` are those of the solution."""
    kind = problem.kind
    shared = inflation(problem.ties, solution.residuals, solution.std_px, kind, sizes)
    is_tie = kind % len(KINDS) != MARK
    if is_tie.any():
        # Errors of the ground are in all photographs, so that they are not told from those of one photograph.
        lacking = shared_by_ground(problem, solution, sizes, is_tie)
        shared *= max(1.0, lacking * float(np.mean((before[kind] / shared)[is_tie])))
    factors = np.array([_first(shared[kind == number]) for number in range(len(before))])
    factors[MARK :: len(KINDS)] = 1.0
    return factors


def _by_depth(seen: Observed, state: State) -> np.ndarray:
    """Kinds (N,) of observations, told apart by depth: waves displace what lies deep by more.

    The kind of dry observations is their own; those of the strata of wet ones follow.
    """
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


def _means(values: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """Mean of values (N,) of each kind; NaN of those that do not occur."""
    count = np.bincount(kind, minlength=len(KINDS))
    return np.where(count > 0, np.bincount(kind, values, len(KINDS)) / np.maximum(count, 1), np.nan)


def _first(values: np.ndarray) -> float:
    return float(values[0]) if len(values) else 1.0


def _without_points(state: State, seen: Observed, keep: np.ndarray) -> State:
    """The state with the points that are left when only these observations are kept."""
    left = seen.at(state.points).only(keep)
    return replace(state, points=left.ties.start)
