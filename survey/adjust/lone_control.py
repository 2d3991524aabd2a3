"""One or two control points held against the block that positions and water place without them.

Three points or more check each other. Of fewer, each pulls the whole block after it, and its own residual stays small.
So the block is adjusted without control; with C the covariance of its parameters, A and B the derivatives of the marks
of a point by its place and by the parameters, S the covariance of its coordinates and s the standard deviation of
marks, the marks less those that its coordinates predict have the covariance ``A S A' + s^2 + B C B'``, which a test of
chi-square takes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import chdtrc

from survey.adjust.control_check import PLACE_A_BLOCK
from survey.adjust.observed import rows_taken
from survey.adjust.prediction import linearise
from survey.adjust.state import RELIEF
from survey.control.points import Control
from survey.photos.tie_points import TiePoints

if TYPE_CHECKING:
    from survey.adjust.rounds import Adjusted
    from survey.folder.survey import Survey

# Beyond this probability the two contradict each other: 3.66 standard deviations of a normal deviate.
_LEAST_PROBABILITY = 2.5e-4
# Fewer positions do not place a block.
_FEWEST_POSITIONS = 3


@dataclass(frozen=True)
class Apart:
    """A control point that a block without control contradicts.

    Attributes
    ----------
    name : str
    east_north, std : (2,) [m]
        Where the block has it, at its height, less its coordinates; and the standard deviations of that.
    """

    name: str
    east_north: np.ndarray
    std: np.ndarray


def is_lone(survey: Survey) -> bool:
    """Whether a survey has control that cannot check itself, and positions that place the block without it."""
    points = () if survey.control is None else survey.control.points
    num = sum(not point.is_check for point in points)
    placed = sum(prior.position is not None for prior in survey.priors.values())
    return 0 < num < PLACE_A_BLOCK and placed >= _FEWEST_POSITIONS


def contradicted_points(control: Control, marks_std_px: float, survey: Survey, free: Adjusted) -> list[Apart]:
    """The control points that a block without control contradicts.

    Parameters
    ----------
    control
    marks_std_px : [px]
    survey : Survey
        Whose views the marks are in.
    free : Adjusted
        The block without control.
    """
    number = {view.name: k for k, view in enumerate(survey.views)}
    layout, state, covariance = free.known.layout, free.solution.state, free.solution.covariance
    against = []
    for point in control.points:
        marks = [mark for mark in control.marks if mark.point == point.name and mark.view in number]
        if point.is_check or not marks:
            continue
        views = np.array([number[mark.view] for mark in marks])
        place = np.asarray(point.local, dtype=np.float64)[None]
        ties = TiePoints(place, np.zeros(len(marks), dtype=np.int64), views, np.array([mark.pixel for mark in marks]))
        rows = rows_taken(ties, free.known.lenses, layout.lens_of)
        linear = linearise(layout, replace(state, points=place), ties, np.zeros((len(marks), RELIEF)), rows)
        residual = (ties.pixel - linear.pixels).ravel()
        if not np.isfinite(residual).all():
            continue
        by_point = linear.by_point.reshape(-1, 3)
        by_parameters = linear.by_parameters.toarray()
        variance = (by_point * np.asarray(point.std) ** 2) @ by_point.T
        variance += by_parameters @ covariance @ by_parameters.T + marks_std_px**2 * np.eye(len(residual))
        square = float(residual @ np.linalg.solve(variance, residual))
        if chdtrc(len(residual), square) < _LEAST_PROBABILITY:
            level = np.linalg.pinv(by_point[:, :2])
            std = np.sqrt(np.einsum("ai,ij,aj->a", level, variance, level))
            against.append(Apart(point.name, level @ residual, std))
    return against


def lone_warning(against: list[Apart]) -> str:
    """The contradiction in words."""
    listed = " and ".join(
        f"{each.name} by {each.east_north[0]:.2f} m east and {each.east_north[1]:.2f} m north "
        f"(+- {each.std[0]:.2g} and {each.std[1]:.2g} m)"
        for each in against
    )
    return (
        f"positions and water, which place the block without control, have another place for control: {listed}. "
        "Control is followed, and nothing else tells which is right: positions without corrections may share an error "
        "of metres; else coordinates, name or mark are wrong. A third control point would tell"
    )
