"""Roll of a block about the line that its positions lie on, as a prior, as a result, and its standard deviation.

Structure from motion leaves the rotation of a block open, and positions on a line the roll about it. The weak priors of
single rotations (`survey.adjust.block.priors.ROTATION_STD`) count from where the block starts and would hold the roll
by nothing that was measured. With D their precision, f the parameters that a roll of the whole block by one radian
changes, g the mean of the rolls of its photographs and s its standard deviation by attitudes, they are replaced by

    D - D f f' D / (f' D f) + g' g / s^2

whose only prior on a common roll is that by the attitudes. All else comes from the photographs: rays that bend at level
water, the shoreline, and control points with their marks. The standard deviation of the roll is that of g in the
covariance of the adjustment.

Where level water alone holds the roll, its standard deviation is by the profile of the cost. Points move along arcs as
a block rolls, so that steps of the adjustment are refused long before they reach the least cost of a flat valley, and
its curvature there says little of how wide the valley is. So the roll is held at angles on both sides of where the
adjustment ended, all else follows, and the block is adjusted again from the best of them. The standard deviation is by
the first angle on each side at which the cost has risen by so much that its parabola through there can be trusted
(profile likelihood: D. Bates and D. Watts, Nonlinear Regression Analysis, 1988, section 6.1).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from survey.adjust.block.bundle import NotConvergedError, Solution, cost, levenberg_marquardt, solve
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import NUM_POSE, Layout, State
from survey.photos.poses import connected_parts, least_track
from survey.sfm.control_fit import line_of_control
from survey.sfm.gps_fit import LineAxes, PositionLine, gps_std, line_of, roll_by_attitudes

if TYPE_CHECKING:
    from survey.control.points import ControlPoint
    from survey.folder.pose_priors import PosePrior
    from survey.folder.survey import Survey
    from survey.photos.cameras import View


# Of a roll without attitudes, or whose profile no angle leaves: keeps the normal equations regular.
_OPEN_STD = math.radians(20.0)
# Fewer control points than this do not tell a line from an area.
_FEWEST = 3


@dataclass(frozen=True, eq=False)
class Roll:
    """The common roll of some photographs."""

    views: np.ndarray  # (K,) int64
    across: LineAxes  # The line
    turns: np.ndarray  # (K, 3): of each photograph, the axis of the line in cam
    # [rad]: by how much attitudes have the block rolled from the rotations that the survey has; 0 without any
    start: float
    std: float  # [rad]: of the roll by attitudes
    num_attitudes: int

    def mean_roll(self, layout: Layout) -> np.ndarray:
        """g (P,): the mean roll of the photographs by the parameters."""
        return self._by_turns(layout, self.turns / len(self.views))

    def roll_of_block(self, layout: Layout) -> np.ndarray:
        """f (P,): what a roll of all photographs by one radian changes of the rotations."""
        return self._by_turns(layout, self.turns)

    def std_by(self, layout: Layout, covariance: np.ndarray) -> float:
        """Standard deviation [rad] of the roll after an adjustment with a covariance (P, P)."""
        mean = self.mean_roll(layout)
        return math.sqrt(max(float(mean @ covariance @ mean), 0.0))

    def angle_between(self, before: np.ndarray, after: np.ndarray) -> float:
        """Angle [rad] about the line from rotations (V, 3, 3) of all views to others."""
        return roll_by_attitudes(self.across, before[self.views], after[self.views])

    def _by_turns(self, layout: Layout, turns: np.ndarray) -> np.ndarray:
        vector = np.zeros(len(layout))
        poses = vector[layout.first_pose :].reshape(-1, NUM_POSE)
        poses[self.views, 3:] = turns
        return vector


def rolls_of(survey: Survey) -> tuple[Roll, ...]:
    """The rolls that positions leave open, of each part that shares no points with others; none of poses of a file."""
    if survey.observations.ties is None or survey.config.cameras.poses is not None:
        return ()
    part = connected_parts(len(survey.views), survey.observations.ties.point, survey.observations.ties.view)
    found = [_roll_of(survey, np.flatnonzero(part == number)) for number in range(int(part.max(initial=-1)) + 1)]
    return tuple(roll for roll in found if roll is not None)


def rolled_by_attitudes(rotations: np.ndarray, rolls: Sequence[Roll]) -> np.ndarray:
    """Rotations (V, 3, 3) of a survey, rolled to where attitudes have them."""
    rotations = rotations.copy()
    for roll in rolls:
        rotations[roll.views] = rotations[roll.views] @ roll.across.rolled(roll.start).rotation.T
    return rotations


def roll_priors(rolls: Sequence[Roll], layout: Layout, std: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows (2 K, P) and signs (2 K,) that take the start out of the priors and attitudes in; ``std`` (P,) of these.

    With the parameters x less their means, they add the sum of ``sign (row x)^2`` to the squares of the priors.
    """
    rows = np.zeros((2 * len(rolls), len(layout)))
    for number, roll in enumerate(rolls):
        direction = roll.roll_of_block(layout)
        strong = direction / std**2
        rows[2 * number] = strong / math.sqrt(float(direction @ strong))
        rows[2 * number + 1] = roll.mean_roll(layout) / roll.std
    return rows, np.tile([-1.0, 1.0], len(rolls))


def _roll_of(survey: Survey, views: np.ndarray) -> Roll | None:
    """The roll of some views, where their positions lie on a line."""
    chosen = [survey.views[k] for k in views]
    priors = [survey.observations.priors.get(view.name) for view in chosen]
    placed = [(v.camera.centre, p) for v, p in zip(chosen, priors, strict=True) if p and p.position is not None]
    line = (
        _line_of_positions(placed)
        if len(placed) >= least_track(len(survey.views))
        else _line_of_control(survey, chosen)
    )
    if line is None:
        return None
    across = LineAxes.of(line)
    rotations = np.array([view.camera.cam_from_local for view in chosen])
    known = [k for k, prior in enumerate(priors) if prior and prior.attitude is not None]
    start, std = 0.0, _OPEN_STD
    if known:
        attitudes = [prior.attitude for prior in priors if prior and prior.attitude is not None]
        start = roll_by_attitudes(across, rotations[known], np.array(attitudes))
        std = math.radians(max(prior.attitude_std_deg for prior in priors if prior and prior.attitude is not None))
    return Roll(views, across, rotations @ across.along, start, std, len(known))


def _line_of_positions(placed: Sequence[tuple[np.ndarray, PosePrior]]) -> PositionLine | None:
    """The line of the positions of photographs with these centres (3,) [m], local, and priors."""
    positions = np.array([prior.position for _, prior in placed])
    stated = [float(prior.position_std.max()) for _, prior in placed if prior.position_std is not None]
    off = np.array([centre for centre, _ in placed]) - positions
    # Control may have moved the block as one.
    scatter = gps_std(off - np.median(off, axis=0))
    return line_of(positions, max(float(scatter.max()), float(np.median(stated)) if stated else 0.0))


def spans_area(survey: Survey, roll: Roll) -> bool:
    """Whether the control points that two of its photographs show lie over an area."""
    given = _control_points_in(survey, [survey.views[k] for k in roll.views], 2)
    return len(given) >= _FEWEST and line_of_control(given) is None


def _line_of_control(survey: Survey, views: Sequence[View]) -> PositionLine | None:
    """The line of the control points that some views show."""
    given = _control_points_in(survey, views, 1)
    return line_of_control(given) if len(given) >= _FEWEST else None


def _control_points_in(survey: Survey, views: Sequence[View], least: int) -> list[ControlPoint]:
    """The control points with so many marks in some views."""
    names = {view.name for view in views}
    control = survey.observations.control
    if control is None:
        return []
    shown = Counter(mark.point for mark in control.marks if mark.view in names)
    return [point for point in control.points if shown[point.name] >= least and not point.is_check]


# Angles [deg] at which the roll is held, on both sides.
_ANGLES_DEG = range(3, 22, 3)
# Standard deviation [rad] of the prior that holds it there.
_HOLD_STD = math.radians(0.003)
# Rises of the cost, in units of variances: less is a part of the valley; one that starts an adjustment anew.
_OF_VALLEY, _BETTER = 3.0, 0.5
# Beyond a rise of this nothing more is looked for on that side.
_MOST_RISE = 30.0


class ProfilePoint(NamedTuple):
    """The block at a roll that was held."""

    angle: float  # [rad]: from where the adjustment ended
    cost: float
    state: State


def minimise_over_roll(
    problem: Problem, solution: Solution, variance_factor: np.ndarray, roll: Roll
) -> tuple[Solution, float]:
    """The solution of least cost over a roll, and the standard deviation [rad] of that roll by its profile.

    Parameters
    ----------
    variance_factor : (N,)
        As for `survey.adjust.block.bundle.solve`.
    """
    sides = [_scan_profile(problem, solution, variance_factor, roll, sign) for sign in (1, -1)]
    profile = [each for side, _ in sides for each in side]
    least = cost(problem, solution.state, solution.std_px, variance_factor)
    at, moved = 0.0, 0.0
    best = min(profile, key=lambda each: each.cost, default=None)
    if best is not None and best.cost < least - _BETTER:
        at, std_px = best.angle, solution.std_px
        try:
            solution = solve(problem, best.state, variance_factor=variance_factor)
        except NotConvergedError:
            # What was found stays, as far off as the better angle.
            least, moved = best.cost, abs(at)
        else:
            at += roll.angle_between(best.state.rotations, solution.state.rotations)
            least = min(cost(problem, solution.state, std_px, variance_factor), best.cost)
    rises = [(each.angle - at, each.cost - least) for each in profile]
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
        known += beyond[:1] if beyond else [_OPEN_STD] if is_whole else []
    return max(known, default=_OPEN_STD)


def _scan_profile(
    problem: Problem, solution: Solution, variance_factor: np.ndarray, roll: Roll, sign: int
) -> tuple[list[ProfilePoint], bool]:
    """The block with the roll held at angles to one side, each from the last; False where an adjustment failed."""
    found: list[ProfilePoint] = []
    state, before = solution.state, 0.0
    mean = roll.mean_roll(problem.layout)
    shown = np.unique(problem.ties.point[np.isin(problem.ties.view, roll.views)])
    rows, signs = problem.priors.rows, problem.priors.signs
    assert rows is not None
    assert signs is not None
    least = cost(problem, solution.state, solution.std_px, variance_factor)
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
            rows=np.vstack([rows, mean / _HOLD_STD]),
            signs=np.append(signs, 1.0),
        )
        try:
            state, _ = levenberg_marquardt(replace(problem, priors=priors), state, solution.std_px, variance_factor)
        except NotConvergedError:
            return found, False
        before = angle
        found.append(ProfilePoint(angle, cost(problem, state, solution.std_px, variance_factor), state))
        if found[-1].cost > least + _MOST_RISE:
            break
    return found, True


def inflate_roll(problem: Problem, covariance: np.ndarray, roll: Roll, std: float) -> np.ndarray:
    """Covariance (P, P) with the std [rad] of the roll raised, and those of all correlated parameters with it."""
    along = covariance @ roll.mean_roll(problem.layout)
    variance = float(roll.mean_roll(problem.layout) @ along)
    return covariance + max(std**2 / variance - 1.0, 0.0) / variance * np.outer(along, along)
