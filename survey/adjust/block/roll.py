"""Roll of a block about the line that its positions lie on, as a prior, as a result, and its standard deviation.

Structure from motion leaves the rotation of a block open, and positions on a line the roll about it. The weak priors of
single rotations (`survey.adjust.block.priors.ROTATION_STD`) count from where the block starts and would hold the roll
by nothing that was measured. With D their precision, f the parameters that a roll of the whole block by one radian
changes, g the mean of the rolls of its photographs and s its standard deviation by attitudes, they are replaced by

    D - D f f' D / (f' D f) + g' g / s^2

whose only prior on a common roll is that by the attitudes. All else comes from the photographs: rays that bend at level
water, the shoreline, and control points with their marks. The standard deviation of the roll is that of g in the
covariance of the adjustment.

Level water alone does not hold it well enough: over the valley that rays bent at a level plane leave, the curvature at
the end of an adjustment says three times too little of its width (`survey.adjust.observability.roll_notes` refuses it).
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from survey.adjust.block.state import NUM_POSE, Layout
from survey.control.points import ControlPoint
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.poses import connected_parts, least_track
from survey.sfm.control_fit import line_of_control
from survey.sfm.gps_fit import LineAxes, PositionLine, gps_std, line_of, roll_by_attitudes

# Of a roll without attitudes: keeps the normal equations regular.
_OPEN_STD = math.radians(20.0)
# Fewer control points than this do not tell a line from an area.
_FEWEST = 3


@dataclass(frozen=True, eq=False)
class Roll:
    views: np.ndarray  # (K,) int64
    across: LineAxes  # The line
    turns: np.ndarray  # (K, 3): of each photograph, the axis of the line in cam
    # [rad]: by how much attitudes have the block rolled from the rotations that the survey has; 0 without any
    start: float
    std: float  # [rad]: of the roll by attitudes
    num_attitudes: int

    def of_block(self, layout: Layout) -> np.ndarray:
        """f (P,): what a roll of all photographs by one radian changes of the rotations; over their number it is g."""
        vector = np.zeros(len(layout))
        vector[layout.first_pose :].reshape(-1, NUM_POSE)[self.views, 3:] = self.turns
        return vector

    def std_by(self, layout: Layout, covariance: np.ndarray) -> float:
        """Standard deviation [rad] of the roll after an adjustment with a covariance (P, P)."""
        mean = self.of_block(layout) / len(self.views)
        return math.sqrt(max(float(mean @ covariance @ mean), 0.0))


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
        direction = roll.of_block(layout)
        strong = direction / std**2
        rows[2 * number] = strong / math.sqrt(float(direction @ strong))
        rows[2 * number + 1] = direction / len(roll.views) / roll.std
    return rows, np.tile([-1.0, 1.0], len(rolls))


def _roll_of(survey: Survey, views: np.ndarray) -> Roll | None:
    """The roll of some views, where their positions lie on a line."""
    chosen = [survey.views[k] for k in views]
    priors = [survey.observations.priors.get(view.name) for view in chosen]
    placed = [(v.camera.centre, p) for v, p in zip(chosen, priors, strict=True) if p and p.position is not None]
    if len(placed) >= least_track(len(survey.views)):
        line = _line_of_positions(placed)
    else:
        given = _control_points_in(survey, chosen, 1)
        line = line_of_control(given) if len(given) >= _FEWEST else None
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


def _control_points_in(survey: Survey, views: Sequence[View], least: int) -> list[ControlPoint]:
    """The control points with so many marks in some views."""
    names = {view.name for view in views}
    control = survey.observations.control
    if control is None:
        return []
    shown = Counter(mark.point for mark in control.marks if mark.view in names)
    return [point for point in control.points if shown[point.name] >= least and not point.is_check]
