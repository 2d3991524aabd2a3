"""What the survey tells the sweep: between which heights a bed is looked for at all."""

from __future__ import annotations

import pytest
from small_survey import TOML, small_survey

from survey.folder.survey import load_survey
from survey.plan.area import limits

FLYING_M = 20.0


def test_a_bed_deeper_than_the_cameras_fly_high_is_looked_for_and_a_bank_nearly_as_high_as_them(tmp_path):
    low, high = limits(load_survey(small_survey(tmp_path / "s")))
    assert low < -1.2 * FLYING_M
    assert 0.75 * FLYING_M < high < FLYING_M


def test_dry_ground_is_looked_for_below_the_cameras(tmp_path):
    survey = load_survey(small_survey(tmp_path / "s", toml=TOML[: TOML.index("[water]")]))
    low, high = limits(survey)
    assert low < high < survey.views[0].camera.centre[2]


def test_limits_are_heights_over_a_plane_wherever_its_point_lies(tmp_path):
    near = limits(load_survey(small_survey(tmp_path / "a")))
    moved = TOML.replace("level_at = [589012", "level_at = [589112")
    far = limits(load_survey(small_survey(tmp_path / "b", toml=moved)))
    # 100 m of level water fall 0.8 mm.
    assert far == pytest.approx(near, abs=2e-3)
