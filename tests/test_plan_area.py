"""What the survey tells the sweep: between which heights a bed is looked for at all."""

from __future__ import annotations

import numpy as np
import pytest
from small_survey import TOML, small_survey

from survey.folder.survey import load_survey
from survey.plan.area import AREA_MARGIN_M, beyond_bounds, grown, limits, local_area
from survey.plan.plan import make_plan

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


def test_the_plan_says_how_far_beyond_the_bounds_the_cloud_ends(tmp_path):
    toml = TOML + "[area]\nbounds = [589006, 5194730, 589019, 5194742]\n"
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    area = local_area(survey)
    assert area is not None
    x0, y0, x1, y1 = grown(area, AREA_MARGIN_M)
    corners = survey.frame.crs_from_local([[x, y, survey.frame.origin[2]] for x in (x0, x1) for y in (y0, y1)])[:, :2]
    low, high = np.reshape(survey.bounds, (2, 2))
    expected = float(max((low - corners).max(), (corners - high).max()))
    # Lengths of the map differ from those of the local frame by some tenths of a thousandth, over 20 m here.
    assert beyond_bounds(survey) == pytest.approx(expected, abs=0.01)
    assert beyond_bounds(survey) > AREA_MARGIN_M
    (reason,) = [decision.reason for decision in make_plan(survey).decisions if decision.name == "pixels"]
    assert reason == f"the cloud ends {beyond_bounds(survey):.2f} m beyond [area] bounds"


def test_without_bounds_nothing_is_beyond_them(tmp_path):
    assert beyond_bounds(load_survey(small_survey(tmp_path / "s"))) == 0.0
