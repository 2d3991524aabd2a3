"""Two photographs without poses: placed by control, adjusted by what they tell, refused where that is too little."""

import numpy as np
import pytest
from drawn_pair import FRAME, draw_pair

from survey.adjust.applied import apply_adjustment
from survey.adjust.refine import adjust_survey
from survey.adjust.result.std_common import std_common
from survey.errors import SurveyError
from survey.folder.survey import load_survey
from survey.photos.poses import TiePoints, least_track


@pytest.mark.parametrize("wet", [pytest.param(False, marks=pytest.mark.slow), True])
def test_two_photographs_placed_by_control_have_heights_within_their_std(tmp_path, wet):
    pair = draw_pair(tmp_path / "pair", seed=int(wet), wet=wet)
    survey = load_survey(pair.folder)
    assert len(survey.views) == 2
    assert any("placed by control points alone" in each for each in survey.findings.assumptions)
    found = adjust_survey(survey, use_windows=False)
    points = FRAME.local_from_crs(survey.frame.crs_from_local(found.points[: -len(found.control)]))
    error = points[:, 2] - pair.height(points[:, :2])
    std = std_common(
        found.points[: -len(found.control)], np.full(len(error), wet), apply_adjustment(survey, found), found, 0.05
    )
    # A point's own error, by a third of a pixel of parallax, is 0.1 m at this ratio of base to height.
    assert np.mean(np.abs(error) < 1.96 * np.hypot(std, 0.1)) > 0.9
    assert np.abs(np.median(error)) < 0.25
    assert np.median(std) < 0.3


def test_positions_too_near_for_their_accuracy_do_not_tell_the_scale(tmp_path):
    control = draw_pair(tmp_path / "control", num_control=2, gps=True, grey=True)
    with pytest.raises(
        SurveyError,
        match=r"scale of two photographs is not known.* 5\.\d+ m apart.* 3 m each.* of 2 there, 2 are marked",
    ):
        load_survey(control.folder)


def test_two_photographs_with_nothing_but_a_lens_are_refused_with_what_would_place_them(tmp_path):
    pair = draw_pair(tmp_path / "pair", num_control=0, grey=True)
    with pytest.raises(SurveyError, match=r"0 of 2 images have a GPS .* at least 2, or at least 3 control points"):
        load_survey(pair.folder)


def test_a_focal_length_that_nothing_tells_is_asked_for(tmp_path):
    pair = draw_pair(tmp_path / "pair", settings="rolling_shutter_s = 0.0\n", grey=True)
    with pytest.raises(SurveyError, match=r"two images tell none; give \[cameras\] focal_px"):
        load_survey(pair.folder)


def test_positions_alone_leave_the_roll_open(tmp_path):
    settings = "focal_px = 600.0\nposition_std_m = 0.02\n"
    pair = draw_pair(tmp_path / "pair", wet=False, num_control=0, gps=True, settings=settings, grey=True)
    with pytest.raises(SurveyError, match=r"2 GPS positions lie on one line .* which does not determine the roll"):
        load_survey(pair.folder)


def test_a_point_needs_as_many_observations_as_its_block_has_photographs_three_at_most():
    assert [least_track(num) for num in (2, 3, 40)] == [2, 3, 3]
    point, view = np.array([0, 0, 1]), np.array([0, 1, 0])
    ties = TiePoints(np.zeros((2, 3)), point, view, np.zeros((3, 2)), least_track(2))
    assert len(ties.only(np.ones(3, dtype=bool))) == 1
    assert TiePoints.together([ties, ties]).least == 2
