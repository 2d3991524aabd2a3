"""Between which heights a bed is looked for: as asked for, by matched points on straight rays, or by the flight."""

from dataclasses import replace

import numpy as np
import pytest
from small_survey import E0, LEVEL, N0, TOML, small_survey
from test_adjust_water import survey_with

from survey.errors import ConfigError
from survey.folder.survey import load_survey
from survey.photos.poses import TiePoints
from survey.plan.area import limits
from survey.plan.choices import Choices
from survey.plan.heights import dry_ground
from survey.plan.plan import make_plan
from survey.settings.config import parse_config
from survey.sfm.poses import SfmResult
from tests.changed_survey import changed
from tests.drawn_block import HEIGHT, TRUTH, convergent, meeting_of_straight_rays, nadir, tie_points, water_plane

BED = (-5.0, -0.5)


def with_straight_points(tmp_path, cameras, rng, *, bed=BED):
    """A survey with points where straight rays to a bed between two heights, local, meet best."""
    ties = tie_points(cameras, rng, count=400, std_px=0.1, low=bed[0], high=bed[1])
    survey = survey_with(tmp_path, cameras)
    return changed(survey, points=meeting_of_straight_rays(cameras, ties))


@pytest.mark.parametrize("cameras", [nadir(), convergent(), convergent()[5:13], convergent()[13:17]])
def test_points_of_straight_rays_give_a_range_that_holds_the_whole_bed_and_little_more(tmp_path, rng, cameras):
    survey = with_straight_points(tmp_path, cameras, rng)
    low, high = limits(survey)
    apparent = survey.observations.points[:, 2] - TRUTH[0]
    assert apparent.min() > 0.85 * (BED[0] - TRUTH[0])
    assert low < BED[0] - TRUTH[0] - 1.0
    assert high > BED[1] - TRUTH[0] + 1.0
    far_low, far_high = limits(changed(survey, points=None))
    assert far_high - far_low > 3.0 * (high - low)


def test_points_to_one_side_lie_above_their_sagittal_and_within_their_tangential_images(tmp_path, rng):
    """Four views from one quarter, 45 degrees off: times n is not deep enough for what they see."""
    cameras = convergent()[13:17]
    survey = with_straight_points(tmp_path, cameras, rng, bed=(-5.0, -4.9))
    water = water_plane(TRUTH)
    apparent = np.median(water.depth(survey.observations.points))
    assert 1.335 * apparent < 4.5
    assert "no lower than" in make_plan(survey, Choices(device="cpu")).decisions[-2].reason
    assert limits(survey)[0] < -5.3


def test_the_plan_warns_of_a_deeper_bed_where_few_points_are_under_water(tmp_path, rng):
    survey = with_straight_points(tmp_path, nadir(), rng)
    raised = changed(survey, points=survey.observations.points + np.array([0.0, 0.0, 4.0]))
    for found, is_warned in ((survey, False), (raised, True)):
        decision = next(d for d in make_plan(found, Choices(device="cpu")).decisions if d.name == "range of heights")
        assert ("give [area] heights if its bed may lie deeper" in decision.reason) == is_warned


def test_wrong_matches_do_not_widen_the_range_and_too_few_points_are_not_asked(tmp_path, rng):
    survey = with_straight_points(tmp_path, convergent(), rng)
    wrong = np.array([[0.0, 0.0, 25.0]])
    spoilt = changed(survey, points=np.concatenate([survey.observations.points, wrong]))
    assert limits(spoilt) == pytest.approx(limits(survey), abs=0.3)
    assert limits(changed(survey, points=survey.observations.points[:50])) == limits(changed(survey, points=None))


def test_no_range_goes_beyond_what_a_flight_allows(tmp_path, rng):
    survey = with_straight_points(tmp_path, convergent(), rng)
    up = np.array([0.0, 0.0, 30.0])
    far_low, far_high = limits(changed(survey, points=None))
    low, high = limits(
        changed(survey, points=np.concatenate([survey.observations.points + up, survey.observations.points - up]))
    )
    assert (low, high) == (far_low, far_high)
    assert far_high < HEIGHT


def test_points_give_the_ground_of_a_dry_survey_whatever_the_overlap_suggests(tmp_path, rng):
    survey = with_straight_points(tmp_path, nadir(), rng)
    dry = replace(survey, water=None, config=replace(survey.config, water=None))
    low, high = limits(dry)
    assert low < survey.observations.points[:, 2].min()
    assert survey.observations.points[:, 2].max() < high
    assert high - low < 15.0


def test_heights_in_the_settings_are_taken_as_they_are(tmp_path):
    toml = TOML + f"[area]\nheights = [{LEVEL - 4.0}, {LEVEL + 1.5}]\n"
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    # Level water lies under its tangential plane by a hundredth of a millimetre at 10 m.
    assert limits(survey) == pytest.approx((-4.0, 1.5), abs=1e-3)
    decision = next(d for d in make_plan(survey, Choices(device="cpu")).decisions if d.name == "range of heights")
    assert decision.choice == "-4.0 to 1.5 m over the water"
    assert "[area] heights" in decision.reason


def test_heights_in_the_settings_have_the_unit_of_crs(tmp_path):
    foot = 1200.0 / 3937.0
    toml = TOML.replace("EPSG:25832+5778", "EPSG:25832+6360").replace(f"{LEVEL}", f"{foot * LEVEL}")
    toml += f"[area]\nheights = [{LEVEL - 4.0}, {LEVEL + 1.5}]\n"
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    # Level water lies under its tangential plane by next to nothing.
    assert limits(survey) == pytest.approx((-4.0 * foot, 1.5 * foot), abs=1e-3)
    assert dry_ground(survey).height - survey.water.point[2] == pytest.approx(-1.25 * foot, abs=1e-3)


def test_heights_hold_everywhere_over_sloped_water(tmp_path):
    toml = TOML + f"slope_east = 0.06\n[area]\nheights = [{LEVEL - 4.0}, {LEVEL + 1.5}]\n"
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    low, high = limits(survey)
    # The cameras stand 0 to 9 m east of where the level holds.
    for east, height in ((0.0, LEVEL + 1.5), (9.0, LEVEL - 4.0)):
        over = -survey.water.depth(survey.frame.local_from_crs([E0 + east, N0, height]))
        assert low - 1e-6 <= over <= high + 1e-6


@pytest.mark.parametrize("value", ["[3.0, 3.0]", "[4.0, 3.0]", "[1.0]", "3.0", "[1.0, 'a']"])
def test_heights_that_are_no_range_are_refused(value):
    with pytest.raises(ConfigError, match=r"area\.heights"):
        parse_config(f"[area]\nheights = {value}")


def test_heights_above_the_cameras_are_refused_with_a_mend(tmp_path):
    toml = TOML + f"[area]\nheights = [0.0, {LEVEL + 25.0}]\n"
    survey = load_survey(small_survey(tmp_path / "s", toml=toml))
    with pytest.raises(ConfigError, match=r"upper end lies 5\.0 m above the lowest camera; give"):
        limits(survey)


def test_structure_from_motion_brings_its_tie_points(tmp_path, monkeypatch, rng):
    posed = load_survey(small_survey(tmp_path / "posed", gps=True))
    ties = TiePoints(rng.normal(size=(6, 3)), np.repeat(np.arange(6), 3), np.tile(np.arange(3), 6), np.zeros((18, 2)))
    solved = SfmResult(posed.frame, posed.views, (), np.zeros((len(posed.views), 3)), ties)
    monkeypatch.setattr("survey.sfm.poses.solve_poses", lambda *arguments, **settings: solved)
    toml = TOML.replace('poses = "cameras.csv"\n', "")
    folder = small_survey(tmp_path / "bare", gps=True, toml=toml)
    (folder / "cameras.csv").unlink()
    np.testing.assert_array_equal(load_survey(folder).observations.points, ties.start)
