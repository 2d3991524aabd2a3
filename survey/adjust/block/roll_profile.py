"""Profile of the cost of an adjustment over the roll of a block about a line, where level water alone holds it.

Points move along arcs as a block rolls, so that steps of the adjustment are refused long before they reach the least
cost of a flat valley, and its curvature there says little of how wide the valley is. So the roll is held at angles on
both sides of where the adjustment ended, all else follows, and the block is adjusted again from the best of them. The
standard deviation of the roll is by the first angle on each side at which the cost has risen by so much that its
parabola through there can be trusted (profile likelihood: D. Bates and D. Watts, Nonlinear Regression Analysis, 1988,
section 6.1).
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from survey.adjust.block.bundle import NotConvergedError, Solution, cost, levenberg_marquardt, solve
from survey.adjust.block.problem import Problem
from survey.adjust.block.roll import Roll
from survey.adjust.block.state import State

# Angles [deg] at which the roll is held, on both sides.
_ANGLES_DEG = range(3, 22, 3)
# What holds it there, as a standard deviation [rad].
_HELD = math.radians(0.003)
# Rises of the cost, in units of variances: less is a part of the valley; one that starts an adjustment anew.
_OF_VALLEY, _BETTER = 3.0, 0.5
# Beyond a rise of this nothing more is looked for on that side.
_MOST_RISE = 30.0
# Where no angle leaves the valley, nothing is known of the roll.
_OPEN = math.radians(20.0)

# Angle [rad] from where the adjustment ended, cost, and state.
Held = tuple[float, float, State]


def profiled(problem: Problem, solution: Solution, inflation: np.ndarray, roll: Roll) -> tuple[Solution, float]:
    """The solution of least cost over a roll, and the standard deviation [rad] of that roll by its profile.

    Parameters
    ----------
    solution : Solution
        Of it.
    inflation : (N,)
        As for `survey.adjust.block.bundle.solve`.
    """
    sides = [_scanned(problem, solution, inflation, roll, sign) for sign in (1, -1)]
    held = [each for side, _ in sides for each in side]
    least = cost(problem, solution.state, solution.std_px, inflation)
    at, moved = 0.0, 0.0
    best = min(held, key=lambda each: each[1], default=None)
    if best is not None and best[1] < least - _BETTER:
        at, std_px = best[0], solution.std_px
        try:
            solution = solve(problem, best[2], inflation=inflation)
        except NotConvergedError:
            # What was found stays, as far off as the better angle.
            least, moved = best[1], abs(at)
        else:
            at += roll.angle_between(best[2].rotations, solution.state.rotations)
            least = min(cost(problem, solution.state, std_px, inflation), best[1])
    rises = [(angle - at, costs - least) for angle, costs, _ in held]
    std = std_by_profile(rises, are_whole=(sides[0][1], sides[1][1]))
    return solution, math.hypot(std, moved)


def std_by_profile(rises: list[tuple[float, float]], are_whole: tuple[bool, bool] = (True, True)) -> float:
    """Standard deviation [rad] of a roll by its profile: the wider side of it.

    Parameters
    ----------
    rises : list of (angle [rad] from the best value, rise of the cost)
    are_whole : (bool, bool)
        Whether the side above and the one below were looked at to their ends; one that was not, and shows no rise,
        tells nothing.
    """
    known = []
    for sign, is_whole in zip((1.0, -1.0), are_whole, strict=True):
        side = sorted((sign * angle, rise) for angle, rise in rises if sign * angle > 0.0)
        beyond = [angle / math.sqrt(rise) for angle, rise in side if rise >= _OF_VALLEY]
        known += beyond[:1] if beyond else [_OPEN] if is_whole else []
    return max(known, default=_OPEN)


def _scanned(
    problem: Problem, solution: Solution, inflation: np.ndarray, roll: Roll, sign: int
) -> tuple[list[Held], bool]:
    """The block with the roll held at angles to one side, each from the last; False where an adjustment failed."""
    found: list[Held] = []
    state, before = solution.state, 0.0
    mean = roll.mean_of(problem.layout)
    shown = np.unique(problem.ties.point[np.isin(problem.ties.view, roll.views)])
    rows, signs = problem.priors.rows, problem.priors.signs
    assert rows is not None
    assert signs is not None
    least = cost(problem, solution.state, solution.std_px, inflation)
    for degrees in _ANGLES_DEG:
        angle = sign * math.radians(degrees)
        turn = roll.across.rolled(angle - before)
        rotations = state.rotations.copy()
        rotations[roll.views] = rotations[roll.views] @ turn.rotation.T
        centres = state.centres.copy()
        centres[roll.views] = turn(centres[roll.views])
        points = state.points.copy()
        points[shown] = turn(points[shown])
        state = replace(state, rotations=rotations, centres=centres, points=points)
        priors = replace(
            problem.priors,
            state=replace(problem.priors.state, rotations=rotations),
            rows=np.vstack([rows, mean / _HELD]),
            signs=np.append(signs, 1.0),
        )
        try:
            state, _ = levenberg_marquardt(replace(problem, priors=priors), state, solution.std_px, inflation)
        except NotConvergedError:
            return found, False
        before = angle
        found.append((angle, cost(problem, state, solution.std_px, inflation), state))
        if found[-1][1] > least + _MOST_RISE:
            break
    return found, True


def widened(problem: Problem, covariance: np.ndarray, roll: Roll, std: float) -> np.ndarray:
    """A covariance (P, P) in which the roll has a standard deviation [rad], and all that follows it its share."""
    along = covariance @ roll.mean_of(problem.layout)
    variance = float(roll.mean_of(problem.layout) @ along)
    return covariance + max(std**2 / variance - 1.0, 0.0) / variance * np.outer(along, along)
