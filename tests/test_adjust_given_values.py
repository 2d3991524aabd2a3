"""Values that are given, and water that nobody named, are held against the photographs."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from slow_cases import slow

from survey.adjust import pose_check
from survey.adjust.block.observed import WINDOW
from survey.adjust.parameter_tests import worst_contradiction
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import MOST_SIGMAS_OF_FOUR
from survey.errors import GivenValueTest, SurveyError
from survey.folder.survey import Survey
from survey.photos.poses import TiePoints
from survey.plan.plan import make_plan, pose_choice
from tests.block_survey import ORIGIN, survey_of, with_water
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock, draw_block

# As good as windows are [px].
NOISE_PX = 0.05


def block_and_survey(seed: int, **changes) -> tuple[DrawnBlock, Survey]:
    """A random block, and its survey with exact poses, lens and water, as a poses file gives them: without a std."""
    settings = {
        "num_views": 12,
        "nadir_only": False,
        "dry_share": 0.0,
        "num_control": 0,
        "pixel_std": NOISE_PX,
        "depth": 3.0,
        "height": 25.0,
    }
    block = draw_block(seed, num_points=250, **(settings | changes))
    survey = survey_of(block)
    views = tuple(
        replace(view, lens=block.lens, camera=block.lens.camera(true.centre, true.cam_from_local))
        for view, true in zip(survey.views, block.cameras, strict=True)
    )
    survey = changed(survey, views=views, priors={}, ties=None, points=None, control=None)
    level, east, north, index = block.water.tolist()
    exact = {"level_m": survey.frame.origin[2] + level, "slope_east": east, "slope_north": north}
    return block, with_water(survey, **exact, refractive_index=index, level_std_m=None, slope_std=None, index_std=None)


def checked(block: DrawnBlock, survey: Survey) -> pose_check.PoseCheck:
    """What the exact places of the block, with their noise, say of the survey."""
    ties = TiePoints(block.start, block.point, block.view, block.pixel)
    return pose_check.check_of_ties(survey, make_plan(survey), WINDOW, ties)


def off(survey: Survey, *, level: float = 0.0, index: float = 0.0) -> Survey:
    """The survey with wrong water."""
    water = survey.config.water
    return with_water(survey, level_m=water.level_m + level, refractive_index=water.refractive_index + index)


def test_water_as_given_is_not_contradicted_and_lies_within_what_is_said():
    told: list[GivenValueTest] = []
    for seed in range(12):
        block, survey = block_and_survey(seed)
        found = checked(block, survey)
        assert found.contradiction is None
        told += found.tests
    scaled = np.array([each.difference / each.std for each in told if each.name == "level_m"])
    assert len(scaled) == 12
    # Of 12 normal deviates the root mean square is one within 20 % (one sigma); three of these. Wider is honest, too.
    assert 0.3 < np.sqrt(np.mean(scaled**2)) < 1.6


@pytest.mark.parametrize(("seed", "error"), [(3, 0.5), (3, -0.5), (9, 0.5)])
def test_a_level_that_is_half_a_metre_off_is_contradicted_with_both_numbers(seed, error):
    block, survey = block_and_survey(seed)
    found = checked(block, off(survey, level=error))
    true = survey.config.water.level_m
    assert (found.contradiction.name, found.contradiction.given) == ("level_m", true + error)
    assert found.contradiction.found == pytest.approx(true, abs=0.2)
    assert f"{true + error:.3f} +- 0.02 m" in str(found.contradiction)


def test_an_index_that_is_wrong_is_contradicted_too():
    block, survey = block_and_survey(3)
    assert checked(block, off(survey, index=0.1)).contradiction.name == "refractive_index"


def test_a_wrong_focal_length_is_not_taken_for_a_wrong_level():
    block, survey = block_and_survey(2)
    fx, fy, *others = block.lens.params
    lens = replace(block.lens, params=(1.01 * fx, 1.01 * fy, *others))
    views = tuple(
        replace(view, lens=lens, camera=lens.camera(view.camera.centre, view.camera.cam_from_local))
        for view in survey.views
    )
    warning = checked(block, replace(survey, views=views)).contradiction
    assert warning is None or (warning.name, warning.is_of_lens) == ("camera0.f", True)


def test_a_level_that_is_as_far_off_as_stated_is_no_contradiction():
    block, survey = block_and_survey(3)
    assert checked(block, with_water(off(survey, level=0.5), level_std_m=0.5)).contradiction is None


def test_nothing_is_said_of_water_under_poses_that_are_contradicted():
    block, survey = block_and_survey(3)
    rng = np.random.default_rng(5)
    views = tuple(
        replace(view, camera=replace(view.camera, centre=view.camera.centre + rng.normal(0.0, 0.1, 3)))
        for view in survey.views
    )
    found = checked(block, off(replace(survey, views=views), level=0.5))
    assert found.misfit_px > 0.1
    assert found.contradiction is None


@pytest.mark.parametrize("level", [0.0, slow(-5.0), slow(-50.0)])
def test_dry_ground_says_nothing_of_water(level):
    for seed in range(4):
        block, survey = block_and_survey(seed, dry_share=1.0)
        found = checked(block, off(survey, level=level))
        assert (found.contradiction, found.flooded) == (None, None)
        assert all(each.is_of_lens for each in found.tests)


@pytest.mark.parametrize("error", [slow(-5.0), slow(-20.0), slow(-50.0), -100.0])
def test_a_level_below_all_of_a_bed_under_water_is_told_with_the_level_that_photographs_show(error):
    scaled = []
    for seed in range(4):
        block, survey = block_and_survey(seed)
        found, true = checked(block, off(survey, level=error)).flooded, survey.config.water.level_m
        assert (found.name, found.given) == ("level_m", true + error)
        assert found.std < 0.1
        scaled.append((found.found - true) / found.std)
    # Of four normal deviates one lies beyond four in one of four thousand cases.
    assert np.abs(scaled).max() < 4.0


def test_a_bed_under_a_level_that_is_about_right_is_not_flooded():
    block, survey = block_and_survey(3)
    assert checked(block, survey).flooded is None
    assert checked(block, off(survey, level=-0.5)).flooded is None


def test_contradicted_water_is_adjusted():
    _, survey = block_and_survey(3)
    warning = GivenValueTest("level_m", 100.5, 0.02, -0.5, 0.03)
    choice, reason = pose_choice(changed(survey, pose_misfit_px=0.01, contradiction=warning), "auto", free_water=False)
    assert choice == "refine"
    assert "level_m is given as 100.500 +- 0.02 m, and a sample of photographs says 100.000 +- 0.03 m" in reason


def test_a_dry_survey_contradicts_no_water():
    dry = survey_of(draw_block(seed=1))
    assert worst_contradiction(replace(dry, water=None), None) is None


def test_one_survey_of_a_thousand_is_doubted_by_chance():
    assert 1.0 - (1.0 - 2.0 * norm.sf(MOST_SIGMAS_OF_FOUR)) ** 4 == pytest.approx(1e-3, rel=0.02)


def block(seed: int, dry_share: float) -> DrawnBlock:
    return draw_block(
        seed, num_points=200, num_views=16, nadir_only=False, dry_share=dry_share, num_control=0, pixel_std=0.15,
        height=25.0, depth=2.5,
    )  # fmt: skip


def lowered(drawn: DrawnBlock, down: float):
    return with_water(survey_of(drawn), level_m=ORIGIN[2] + float(drawn.water[0]) - down)


@pytest.mark.parametrize(("down", "num_blocks"), [(6.0, 1), slow(45.0, 2)])
def test_the_level_that_photographs_show_is_named(down, num_blocks):
    missed = []
    for seed in range(num_blocks):
        drawn = block(seed, 0.3)
        with pytest.raises(SurveyError, match=r"leaves all of the bed dry.*or leave out \[water\] if") as error:
            adjust_survey(lowered(drawn, down), use_windows=False)
        found, std = map(float, re.search(r"level is ([\d.]+) \+- ([\d.]+) m", str(error.value)).groups())
        assert std < 0.3
        # The text has centimetres.
        missed.append((found - ORIGIN[2] - float(drawn.water[0])) / np.hypot(std, 0.005))
    assert np.abs(missed).max() < 4.5


@pytest.mark.slow
def test_a_block_that_is_dry_stays_so():
    for seed in range(2):
        drawn = block(seed, 1.0)
        found = adjust_survey(lowered(drawn, 8.0), use_windows=False)
        assert found.parameter("level_m").value == pytest.approx(ORIGIN[2] + float(drawn.water[0]) - 8.0)


def without_water(seed: int, **settings) -> Survey:
    block = draw_block(
        seed, num_points=250, num_views=16, nadir_only=False, num_control=0, pixel_std=0.3, height=25.0, **settings
    )
    survey = survey_of(block)
    return replace(survey, water=None, config=replace(survey.config, water=None))


def notes_of(survey: Survey) -> list[str]:
    return [text for text in adjust_survey(survey, use_windows=False).warnings if "show water" in text]


@pytest.mark.parametrize(("seed", "dry_share"), [(11, 0.4)])
def test_bent_rays_tell_of_water_over_a_part_of_the_ground(seed, dry_share):
    (text,) = notes_of(without_water(seed, dry_share=dry_share, depth=4.0))
    wet, total = (int(number) for number in re.search(r"(\d+) of (\d+) tie points fit better", text).groups())
    assert wet / total == pytest.approx(1.0 - dry_share, abs=0.2)
    before, after = (float(v) for v in re.search(r"\(([\d.]+) px on straight ones, ([\d.]+) px", text).groups())
    assert before >= after


@pytest.mark.parametrize("seed", [11, slow(12)])
def test_dry_ground_shows_no_water(seed):
    assert notes_of(without_water(seed, dry_share=1.0, depth=4.0)) == []
