"""Control that is wrong is named, and marks of points with few of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import cKDTree

from survey.adjust.block.control_check import has_unchecked_control
from survey.adjust.refine import adjust_survey
from survey.control.points import Control
from survey.folder.pose_priors import PosePrior
from survey.folder.survey import Survey
from tests.block_survey import pose_errors, rms, survey_of
from tests.changed_survey import changed
from tests.drawn_block import draw_block

SAID = "contradict the block as positions and water place it: gcp0 by "


def block_and_survey():
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.35, num_control=7)
    return block, survey_of(block)


def without_positions(survey: Survey) -> Survey:
    return changed(survey, priors={view.name: PosePrior(None, None, None, "none") for view in survey.views})


def with_shift(survey: Survey, number: int, shift) -> Survey:
    points = list(survey.observations.control.points)
    points[number] = replace(points[number], local=points[number].local + np.array(shift))
    return changed(survey, control=replace(survey.observations.control, points=tuple(points)))


@pytest.fixture(scope="module", params=[True, False], ids=["gps", "control alone"])
def right(request):
    """A block with right control, its survey with or without positions, and that adjusted."""
    block, survey = block_and_survey()
    survey = survey if request.param else without_positions(survey)
    return block, survey, adjust_survey(survey, use_windows=False)


@pytest.mark.parametrize("shift", [(0.3, 0.0, 0.0), (0.0, 0.0, -5.0)])
def test_wrong_coordinates_are_named_and_change_nothing(right, shift):
    block, survey, whole = right
    found = adjust_survey(with_shift(survey, 2, shift), use_windows=False)
    (warning,) = found.warnings
    assert "1 control point that the block contradicts, its coordinates left out: gcp2 (off by " in warning
    assert not whole.warnings
    # One point fewer: both are within what the block states.
    assert (np.abs(found.poses.centres - whole.poses.centres) < 3.0 * found.poses.position_std).all()
    errors, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert np.mean(np.abs(errors) < 2.6 * found.poses.position_std) > 0.8
    (point,) = [each for each in found.control if each.is_check]
    np.testing.assert_allclose(point.residual_m, -np.array(shift), atol=0.1)


def test_two_wrong_points_are_both_named():
    _, survey = block_and_survey()
    found = adjust_survey(with_shift(with_shift(survey, 2, (0.4, 0.0, 0.0)), 5, (0.0, 0.3, 0.3)), use_windows=False)
    assert "2 control points" in found.warnings[0]
    assert "gcp2" in found.warnings[0]
    assert "gcp5" in found.warnings[0]


def test_a_wrong_mark_is_named_and_its_point_keeps_its_coordinates():
    _, survey = block_and_survey()
    mark, *rest = survey.observations.control.marks
    wrong = replace(mark, pixel=(mark.pixel[0] + 60.0, mark.pixel[1] - 40.0))
    found = adjust_survey(
        changed(survey, control=replace(survey.observations.control, marks=(wrong, *rest))), use_windows=False
    )
    assert found.warnings == (f"1 mark of control that the block contradicts, left out: {mark.point} in {mark.view}",)
    assert not any(point.is_check for point in found.control)


def test_control_that_is_worse_than_stated_counts_as_good_as_it_fits(rng):
    block, survey = block_and_survey()
    points = tuple(
        replace(point, local=point.local + rng.normal(0.0, 0.1, 3)) for point in survey.observations.control.points
    )
    found = adjust_survey(
        changed(survey, control=replace(survey.observations.control, points=points)), use_windows=False
    )
    (warning,) = found.warnings
    assert "times worse than their standard deviations" in warning
    assert 4.0 < float(warning.split("fit the block ")[1].split(" times")[0]) < 25.0
    errors, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert rms(errors) < 0.03


def test_three_points_that_contradict_each_other_hold_the_block_with_a_word():
    # Points that lie along a line would leave the roll about it open.
    survey = survey_of(draw_block(7, num_points=150, num_views=18, dry_share=0.35, num_control=3))
    found = adjust_survey(with_shift(without_positions(survey), 1, (0.5, 0.3, 0.0)), use_windows=False)
    assert any("times worse than their standard deviations" in warning for warning in found.warnings)
    assert np.isfinite(found.poses.position_std).all()


def test_blocks_without_positions_are_as_uncertain_as_their_control_leaves_them():
    within = []
    for seed in (8, 11, 12):
        block = draw_block(seed, num_points=150, num_views=18, dry_share=0.35, num_control=7)
        survey = survey_of(block)
        found = adjust_survey(without_positions(survey), use_windows=False)
        assert found.statistics.gps_std_m is None
        errors, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
        assert rms(errors) < 0.2
        within.append(np.abs(errors) < 1.96 * found.poses.position_std)
    # Errors of a block are all of a few modes: tilts, scale, bend.
    assert np.mean(within) > 0.85
    with_gps = adjust_survey(survey, use_windows=False)
    assert (found.poses.position_std.mean(axis=0) > with_gps.poses.position_std.mean(axis=0)).all()


def with_one_point(seed: int, off=(0.0, 0.0, 0.0), num_marks: int | None = None) -> Survey:
    """A block with GPS good to 2 cm and one control point, its coordinates off by so much."""
    survey = survey_of(draw_block(seed, num_points=150, num_views=18, dry_share=0.35, num_control=1))
    (point,) = survey.observations.control.points
    point = replace(point, local=point.local + np.array(off))
    return changed(
        survey,
        control=replace(
            survey.observations.control, points=(point,), marks=survey.observations.control.marks[:num_marks]
        ),
    )


@pytest.mark.parametrize("num_marks", [1, None])
def test_a_wrong_point_that_moves_the_block_is_named(num_marks):
    found = adjust_survey(with_one_point(3, (1.0, -0.5, 0.0), num_marks), use_windows=False)
    words = " ".join(found.warnings)
    # A point with marks enough to be judged is left out, and one with a single mark moves the block.
    assert SAID in words or "control point that the block contradicts, its coordinates left out: gcp0" in words
    if num_marks == 1:
        # Where the block has it, less its coordinates.
        assert f"{SAID}-1.0" in words or f"{SAID}-0.9" in words


def test_a_right_point_is_not():
    assert not any(SAID in warning for warning in adjust_survey(with_one_point(3), use_windows=False).warnings)


def test_only_control_that_cannot_check_itself_is_asked_about_and_only_where_positions_place_the_block():
    survey = with_one_point(3)
    assert has_unchecked_control(survey)
    assert not has_unchecked_control(changed(survey, control=None))
    nowhere = {view.name: PosePrior(None, None, None, "none") for view in survey.views}
    assert not has_unchecked_control(changed(survey, priors=nowhere))
    many = survey_of(draw_block(3, num_points=150, num_views=18, dry_share=0.35, num_control=3))
    assert not has_unchecked_control(many)


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
