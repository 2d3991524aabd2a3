"""What `check` promises from poses alone, against what adjustments of drawn blocks reach."""

import math
from dataclasses import replace

import numpy as np
import pytest

from survey.adjust.result.foreseen import MATCH_STD_PX, foresee, foreseen_section, heights_by_depth
from survey.adjust.result.std_common import std_common
from survey.folder.survey import load_survey
from survey.plan.area import ASSUMED_DEPTH_M
from survey.plan.choices import Choices
from survey.plan.plan import make_plan
from survey.simulate.drawn import DrawnScene, draw_survey
from tests.block_survey import survey_of
from tests.changed_survey import changed
from tests.drawn_block import draw_block


def with_poses_alone(seed: int, **kind):
    """The survey of a drawn block as from a file of poses."""
    return changed(survey_of(draw_block(seed, **kind)), ties=None)


def test_convergent_views_tell_the_level_and_nadir_ones_do_not():
    convergent, nadir = foresee(with_poses_alone(3)), foresee(with_poses_alone(3, nadir_only=True))
    assert convergent is not None
    assert nadir is not None
    assert convergent.level_std_m < 0.5 * nadir.level_std_m
    assert convergent.angle_deg > nadir.angle_deg


def test_better_water_gives_better_heights():
    survey = with_poses_alone(4)
    water = survey.config.water
    rough, fine = (
        foresee(replace(survey, config=replace(survey.config, water=replace(water, level_std_m=std))))
        for std in (0.1, 0.005)
    )
    assert rough is not None
    assert fine is not None
    assert fine.heights.of_all_m < rough.heights.of_all_m
    assert fine.heights.of_point_m == pytest.approx(rough.heights.of_point_m)


def test_heights_of_two_rays_are_as_their_triangle_says(tmp_path):
    draw_survey(tmp_path / "dry", DrawnScene.tiny(water=False))
    survey = load_survey(tmp_path / "dry")
    found = foresee(survey)
    assert found is not None
    assert math.isnan(found.level_std_m)
    # With V rays spread by the angle a about the vertical the height is good to the pixel over tan(a / 2) sqrt(V):
    # within a factor of two, as rays lie in all directions.
    distance = DrawnScene.tiny().flying_m + DrawnScene.tiny().depth_m
    pixel = MATCH_STD_PX * distance / survey.views[0].camera.fx
    rough = pixel / (math.tan(math.radians(0.5 * found.angle_deg)) * math.sqrt(found.views_of_place[1] / 2.0))
    assert 0.4 < found.heights.of_point_m / rough < 2.5


def test_the_section_says_what_was_assumed_and_what_has_to_be_given():
    section = foreseen_section(with_poses_alone(3, nadir_only=True))
    assert section is not None
    rows = dict(section.rows)
    assert "give it, or add" in rows["level"]
    assert "tie points good to" in rows["assumed"]


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    """A survey whose poses the plan keeps, and its folder."""
    folder = tmp_path_factory.mktemp("foreseen") / "tiny"
    draw_survey(folder, DrawnScene.tiny())
    survey = load_survey(folder)
    assert make_plan(survey).pose_choice == "fixed"
    return survey


def test_heights_over_poses_that_are_kept_are_foreseen_as_a_run_states_them(kept):
    found, adjusted = foresee(kept), foresee(kept, chosen=Choices(poses="refine"))
    assert found is not None
    assert adjusted is not None
    x, y = np.meshgrid(np.linspace(-1.0, 1.0, 12), np.linspace(-1.0, 1.0, 12))
    bed = np.column_stack([x.ravel(), y.ravel(), kept.water.height(x.ravel(), y.ravel()) - ASSUMED_DEPTH_M])
    stated = np.median(std_common(bed, np.full(len(bed), True), kept, None, make_plan(kept).gsd_m))
    assert found.heights.of_all_m == pytest.approx(stated, rel=0.1)
    assert adjusted.heights.of_all_m < 0.85 * stated
    assert found.heights.of_point_m == pytest.approx(adjusted.heights.of_point_m)
    for chosen, words in ((Choices(), "poses and lens kept"), (Choices(poses="refine"), "poses and lens adjusted")):
        section = foreseen_section(kept, chosen=chosen)
        assert section is not None
        assert words in dict(section.rows)["assumed"]


def test_the_depth_that_is_asked_for_is_listed_however_low_the_flight(kept):
    height = make_plan(kept).height_m
    depths = [heights.depth_m for heights in heights_by_depth(kept, 0.8 * height)]
    assert depths == pytest.approx([0.2 * height, 0.4 * height, 0.8 * height])
    assert [heights.depth_m for heights in heights_by_depth(kept, 0.2 * height)][-1] == pytest.approx(0.4 * height)
