"""What an adjustment cannot tell is held at its given value, in the block too."""

import numpy as np
import pytest

from survey.adjust.block.priors import FOCAL_SHARE
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Status
from survey.errors import SurveyError
from tests.block_survey import pose_errors, survey_of, with_water
from tests.changed_survey import changed
from tests.drawn_block import draw_block

# Over flat ground from one height: the focal length trades with the height of the ground.
FLAT = {"num_points": 150, "num_views": 18, "nadir_only": True, "dry_share": 0.0}


@pytest.fixture(scope="module")
def flat():
    block = draw_block(11, **FLAT)
    return block, adjust_survey(survey_of(block), use_windows=False)


def test_a_focal_length_that_is_not_observable_is_the_given_one_in_the_block_too(flat):
    block, found = flat
    focal, row = block.stated_lens.focal[0], found.parameter("camera0.f")
    assert row.status == Status.UNKNOWN
    assert "not observable" in row.verdict
    assert row.value == focal
    assert found.lenses[0].focal[0] == pytest.approx(focal, rel=1e-6)


def test_poses_and_points_follow_the_held_focal_length(flat):
    block, found = flat
    # With poses of another focal length, pixels at the edge of a photograph would be off by several.
    assert found.statistics.std_px["matches"] == pytest.approx(block.pixel_std, rel=0.15)
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert np.mean(np.abs(positions) < 1.96 * found.poses.position_std) > 0.85


def test_a_held_focal_length_is_as_uncertain_as_it_was_given(flat):
    block, found = flat
    at = found.covariance.names.index("camera0.f")
    covariance = found.covariance.matrix
    std = np.sqrt(np.diag(covariance))
    assert std[at] == pytest.approx(FOCAL_SHARE * block.stated_lens.focal[0], rel=1e-6)
    assert np.linalg.eigvalsh(covariance / np.outer(std, std)).min() > -1e-9


def test_a_level_that_is_not_observable_stays_as_it_was_given():
    block = draw_block(11, **FLAT)
    survey = with_water(survey_of(block), level_std_m=0.5)
    found = adjust_survey(survey, use_windows=False)
    assert found.parameter("level_m").status == Status.UNKNOWN
    assert found.water.level_m == survey.config.water.level_m
    at = found.covariance.names.index("height_m")
    assert found.covariance.matrix[at, at] == pytest.approx(0.25, rel=1e-3)


def test_slopes_without_a_level_stay_as_they_were_given():
    block = draw_block(11, **FLAT)
    survey = with_water(survey_of(block), level_std_m=1.0, slope_std=0.2)
    found = adjust_survey(survey, use_windows=False)
    for name in ("level_m", "slope_east", "slope_north"):
        assert found.parameter(name).status == Status.UNKNOWN
        assert getattr(found.water, name) == getattr(survey.config.water, name)


def test_nothing_is_held_that_the_photographs_tell():
    found = adjust_survey(survey_of(draw_block(3, num_points=200, num_views=18, dry_share=0.3)), use_windows=False)
    rows = {row.name: row for row in found.parameters}
    assert rows["level_m"].status == Status.FREE
    assert rows["camera0.f"].status == Status.FREE
    assert rows["camera0.f"].value != rows["camera0.f"].given
    at = found.covariance.names.index("camera0.f")
    assert np.sqrt(found.covariance.matrix[at, at]) == pytest.approx(rows["camera0.f"].std)


@pytest.mark.parametrize("free_water", [False, True])
def test_a_level_that_is_neither_given_nor_observable_is_refused(free_water):
    survey = with_water(survey_of(draw_block(11, **FLAT)), level_std_m=10.0)
    survey = changed(survey, is_level_known=False)
    with pytest.raises(
        SurveyError, match=r"do not determine it \(18 of 18 look straight down\): .*; give the level in \[water\]"
    ):
        adjust_survey(survey, use_windows=False, free_water=free_water)


@pytest.mark.parametrize("nadir_only", [False, True])
def test_a_level_that_matches_leave_wide_open_is_refused_before_windows_are_measured(nadir_only):
    block = draw_block(3, num_points=200, num_views=18, dry_share=0.0 if nadir_only else 0.3, nadir_only=nadir_only)
    survey = changed(with_water(survey_of(block), level_std_m=10.0), is_level_known=False, control=None)
    # There are no photographs: where windows are asked for, the first one is missed.
    expected = r"do not determine it .* poses that were found are kept" if nadir_only else r"000\.jpg"
    with pytest.raises(SurveyError if nadir_only else FileNotFoundError, match=expected):
        adjust_survey(survey)
