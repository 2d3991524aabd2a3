"""Outlier tests of control points in the block: rejected coordinates and marks, and the accuracy of the rest.

With X and B the derivatives of the marks of a point by its place and by the parameters, and r their residuals, the
marks alone put the point at ``place + (X' X)^-1 X' r``. This less its coordinates has the covariance

    S + s^2 (X' X)^-1 + J C J',    J = (X' X)^-1 X' B

with S that of the coordinates, s the standard deviation of the marks and C the covariance of the parameters. Where the
point itself determines the block, C contains it too, and the sum is too large. The residual of the adjusted place is
the sharper test then; its covariance is S less that of the place.

One or two control points are held against a block placed without them, by positions and water
(`control_contradiction`).
Three points or more check each other; of fewer, each pulls the whole block after it, and its own residual stays small.
So the block is adjusted without control; marks less those that the coordinates predict have the covariance
``X S X' + s^2 + B C B'``, which a test of chi-square takes.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc

from survey.adjust.block.bundle import Solution
from survey.adjust.block.normal_matrix import propagated, propagated_variance
from survey.adjust.block.observed import MARK, Observed, original_rows
from survey.adjust.block.prediction import design_matrix, linearise
from survey.adjust.block.priors import PriorKnowledge
from survey.adjust.block.problem import Problem
from survey.adjust.block.state import NUM_POSE, NUM_RELIEF, Layout, State
from survey.control.points import Control
from survey.display.quantities import named
from survey.folder.survey import Survey
from survey.photos.cameras import View
from survey.photos.poses import TiePoints

# A point is rejected whose coordinates are off by more than `_WRONG` standard deviations and by `_STANDS_OUT` times as
# much as most points. A wrong point biases the block at the others, so that some of them are rejected with it: a
# rejected point is readmitted below `_RIGHT`, once the stated std of the others has been widened.
_WRONG, _STANDS_OUT, _RIGHT = 6.0, 2.5, 4.0
# The median of the largest of three normal deviates.
_MEDIAN_OF_THREE = 1.26
# With so many points, most exceed their stated std only where it is too small by such a factor.
_FEWEST, _OVERSTATED = 4, 2.0
# Without positions of cameras a block needs so many points.
PLACE_A_BLOCK = 3
# Least redundancy: where a smaller part of an error remains as residual, this is not a measure of it.
_LEAST_REDUNDANCY = 0.2
# Beyond this probability block and point contradict each other: 3.66 standard deviations of a normal deviate.
_LEAST_PROBABILITY = 2.5e-4
# Fewer positions do not place a block.
_FEWEST_POSITIONS = 3


class StatedPoint(NamedTuple):
    """The coordinates of a control point (3,) [m], local, and their standard deviations."""

    place: np.ndarray
    std: np.ndarray


def stated_points(seen: Observed) -> dict[str, StatedPoint]:
    """Stated coordinates of all control points, by name."""
    first = len(seen.ties) - len(seen.control)
    return {
        name: StatedPoint(seen.ties.start[k], seen.point_std[k]) for k, name in enumerate(seen.control, start=first)
    }


def checked_points(problem: Problem, solution: Solution, seen: Observed, stated: Mapping[str, StatedPoint]) -> Observed:
    """Observations with wrong control freed and optimistic standard deviations widened; the same where none is.

    Only the worst point is freed: it pulls the block away from others, which are judged without it. ``stated`` are the
    control points by name, before any was freed or widened.
    """
    first = len(seen.ties) - len(seen.control)
    std = seen.point_std.copy()
    known = [k for k in range(first, len(std)) if np.isfinite(std[k]).all()]

    def given(point: int) -> StatedPoint:
        return stated[seen.control[point - first]]

    def misfit(point: int, own_std: np.ndarray) -> float:
        return _misfit(problem, solution, seen, point, StatedPoint(given(point).place, own_std))

    off = {k: value for k in known if np.isfinite(value := misfit(k, std[k]))}
    if not off:
        return seen
    median, worst = float(np.median(list(off.values()))), max(off, key=off.__getitem__)
    positions = problem.priors.std[problem.layout.first_pose :].reshape(-1, NUM_POSE)[:, :3]
    can_lose = len(known) > PLACE_A_BLOCK or bool(np.isfinite(positions).any())
    stands_out = len(off) < _FEWEST or off[worst] > _STANDS_OUT * median
    if off[worst] > _WRONG and stands_out and can_lose:
        std[worst] = np.inf
    elif off[worst] > _WRONG and len(off) < _FEWEST:
        # Without the worst point the datum of the block would be undetermined.
        std[known] *= off[worst] / _MEDIAN_OF_THREE
    elif len(off) >= _FEWEST and median > _OVERSTATED * _MEDIAN_OF_THREE:
        std[known] *= median / _MEDIAN_OF_THREE
    else:
        wider = float(np.max(std[known[0]] / given(known[0]).std))
        freed = [k for k in range(first, len(std)) if k not in known and np.isfinite(given(k).std).all()]
        back = [k for k in freed if wider > 1.0 and misfit(k, wider * given(k).std) < _RIGHT]
        if not back:
            return seen
        std[back] = [wider * given(k).std for k in back]
        start = seen.ties.start.copy()
        start[back] = [given(k).place for k in back]
        return replace(seen, point_std=std, ties=replace(seen.ties, start=start))
    return replace(seen, point_std=std)


def _misfit(problem: Problem, solution: Solution, seen: Observed, point: int, given: StatedPoint) -> float:
    """Normalised residual of the coordinates of a control point; infinite where it is not determined."""
    marks = np.flatnonzero(seen.ties.point == point)
    if len(marks) < 2:
        return np.inf
    place = solution.state.points[point]
    rows = None if problem.rows is None else problem.rows[marks]
    ties = TiePoints(place[None], np.zeros_like(marks), seen.ties.view[marks], seen.ties.pixel[marks])
    residuals, by_point, by_parameters = _linearised_marks(
        problem.layout, solution.state, ties, problem.rise_design[marks], rows
    )
    if not np.isfinite(residuals).all():
        return np.inf
    std_px, moved = float(solution.std_px[problem.kind[marks[0]]]), place - given.place

    def normalised(chosen: np.ndarray) -> float:
        inverse = np.linalg.pinv(by_point[chosen])
        variance = given.std**2 + std_px**2 * np.sum(inverse**2, axis=1)
        variance += propagated_variance(inverse @ by_parameters[chosen], solution.covariance)
        return float(np.max(np.abs(moved + inverse @ residuals[chosen]) / np.sqrt(variance)))

    every = np.arange(len(residuals))
    # A single wrong mark is not a wrong point: what counts is what the point is off without it.
    parts = [np.delete(every, [k, k + 1]) for k in every[::2]] if len(marks) > 2 else [every]
    residual = min(normalised(part) for part in parts)
    is_used = bool(np.isfinite(seen.point_std[point]).all())
    return max(residual, _normalised_residual(solution, point, moved, given.std)) if is_used else residual


def _linearised_marks(
    layout: Layout, state: State, ties: TiePoints, rise_design: np.ndarray, rows: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residuals (2 N,) of marks of one point at its start, derivatives by it (2 N, 3) and by parameters (2 N, P)."""
    linear = linearise(layout, replace(state, points=ties.start), ties, rise_design, rows)
    design = design_matrix(layout, ties.view, linear.by_parameters).toarray()
    return (ties.pixel - linear.pixels).ravel(), linear.by_point.reshape(-1, 3), design


def _normalised_residual(solution: Solution, point: int, moved: np.ndarray, stated: np.ndarray) -> float:
    """Normalised residual from the adjusted position of the point."""
    system = solution.system
    root, mixed = system.point_root[point], system.coupling.of_point(point)
    covariance = root.T @ (np.eye(3) + propagated(mixed, solution.covariance)) @ root
    redundancy = 1.0 - np.diag(covariance) / stated**2
    used = redundancy > _LEAST_REDUNDANCY
    return float(np.max(np.abs(moved[used]) / (stated[used] * np.sqrt(redundancy[used])), initial=0.0))


def control_warnings(control: Control | None, views: Sequence[View], used: Observed, state: State) -> list[str]:
    """Warnings that name the control that was left out or widened."""
    if control is None:
        return []
    marks = used.kind == MARK
    first = len(used.ties) - len(used.control)
    shown = {
        (used.control[point - first], views[view].name)
        for point, view in zip(used.ties.point[marks], used.ties.view[marks], strict=True)
    }
    lost = [mark for mark in control.marks if (mark.point, mark.view) not in shown]
    by_name = {point.name: point for point in control.points}
    freed, widened = [], []
    for k, name in enumerate(used.control, start=first):
        point = by_name[name]
        if point.is_check:
            continue
        if np.isfinite(used.point_std[k]).all():
            widened.append(float(np.max(used.point_std[k] / point.std)))
        else:
            off = state.points[k] - point.local
            freed.append(f"{name} (off by {off[0]:.3f} m east, {off[1]:.3f} m north, {off[2]:.3f} m up)")
    warnings = named(
        [f"{mark.point} in {mark.view}" for mark in lost], "mark", "of control that the block contradicts, left out"
    )
    warnings += named(freed, "control point", "that the block contradicts, its coordinates left out")
    if widened and max(widened) > 1.0:
        warnings.append(
            f"control points fit the block {max(widened):.1f} times worse than their standard deviations, which "
            "are increased by this factor; correct [control] std_m, or the coordinates"
        )
    return warnings


def has_unchecked_control(survey: Survey) -> bool:
    """Whether a survey has control that cannot check itself, and positions that place the block without it."""
    control = survey.observations.control
    points = () if control is None else control.points
    num = sum(not point.is_check for point in points)
    placed = sum(prior.position is not None for prior in survey.observations.priors.values())
    return 0 < num < PLACE_A_BLOCK and placed >= _FEWEST_POSITIONS


def control_contradiction(
    control: Control, views: Sequence[View], prior: PriorKnowledge, solution: Solution
) -> str | None:
    """Warning of control points that a block without control, of this prior and solution, contradicts."""
    number = {view.name: k for k, view in enumerate(views)}
    against = []
    for point in control.points:
        marks = [mark for mark in control.marks if mark.point == point.name and mark.view in number]
        if point.is_check or not marks:
            continue
        place, view = np.asarray(point.local, dtype=np.float64), np.array([number[mark.view] for mark in marks])
        ties = TiePoints(place[None], np.zeros_like(view), view, np.array([mark.pixel for mark in marks]))
        rows = original_rows(ties, prior.lenses, prior.layout.lens_of)
        flat = np.zeros((len(marks), NUM_RELIEF))
        residual, by_point, by_parameters = _linearised_marks(prior.layout, solution.state, ties, flat, rows)
        if not np.isfinite(residual).all():
            continue
        variance = (by_point * np.asarray(point.std) ** 2) @ by_point.T
        variance += propagated(by_parameters, solution.covariance) + control.marks_std_px**2 * np.eye(len(residual))
        if chdtrc(len(residual), float(residual @ np.linalg.solve(variance, residual))) < _LEAST_PROBABILITY:
            # Where the block has it, at its height, less its coordinates.
            level = np.linalg.pinv(by_point[:, :2])
            (east, north), std = level @ residual, np.sqrt(propagated_variance(level, variance))
            against.append(
                f"{point.name} by {east:.2f} m east and {north:.2f} m north (+- {std[0]:.2g} and {std[1]:.2g} m)"
            )
    if not against:
        return None
    return (
        f"control points contradict the block as positions and water place it: {' and '.join(against)}. Control is "
        "used. Either the positions have a common error, of metres where they have no corrections, or the coordinates, "
        "the name or a mark of the point are wrong; a third control point would show which"
    )
