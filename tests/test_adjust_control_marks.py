"""Blocks whose control points have few marks, alone on their piece of the ground."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from survey.adjust.refine import adjust_survey
from survey.control.points import Control
from tests.block_survey import pose_errors, rms, survey_of
from tests.changed_survey import changed
from tests.drawn_block import draw_block

# Of tie points from the control points: squares of the ground then hold a control point alone.
APART_M = 6.0


def with_marks(control: Control, num_marks: int) -> Control:
    """The control points with so many marks each."""
    marks, count = [], {}
    for mark in control.marks:
        count[mark.point] = count.get(mark.point, 0) + 1
        if count[mark.point] <= num_marks:
            marks.append(mark)
    return replace(control, marks=tuple(marks))


def survey_with(num_marks: int, *, wet: bool, gps: bool):
    """A drawn block and its survey with control points of so many marks, and no tie point near them."""
    block = draw_block(5, num_points=260, num_views=14, dry_share=0.4, num_control=6, height=25.0, depth=2.0)
    survey = survey_of(block)
    near, _ = cKDTree(block.control_points[:, :2]).query(survey.observations.ties.start[:, :2])
    ties = survey.observations.ties.only((near > APART_M)[survey.observations.ties.point])
    survey = changed(survey, ties=ties, points=ties.start, control=with_marks(survey.observations.control, num_marks))
    if not wet:
        # Of the same block the dry points alone.
        ties = survey.observations.ties.only(
            (survey.water.depth(survey.observations.ties.start) < -0.3)[survey.observations.ties.point]
        )
        survey = changed(survey, ties=ties, points=ties.start)
        survey = replace(survey, water=None, config=replace(survey.config, water=None))
    if not gps:
        survey = changed(survey, priors={})
    return block, survey


# Marks in one or two photographs do not place a block, and some photographs show no dry ground.
@pytest.mark.parametrize(
    ("num_marks", "wet", "gps"),
    [*((marks, wet, True) for marks in (1, 2, 3, 9) for wet in (True, False)), (3, True, False), (9, True, False)],
)
def test_control_points_with_few_marks_are_adjusted_with_the_rest(num_marks, wet, gps):
    block, survey = survey_with(num_marks, wet=wet, gps=gps)
    found = adjust_survey(survey, use_windows=False)
    for values in (found.poses.centres, found.covariance.matrix, found.points, found.residuals.px):
        assert np.isfinite(values).all()
    if wet and gps:
        positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
        # Errors of a block go together; 2 as in the random blocks.
        assert rms(positions / found.poses.position_std) < 2.0
