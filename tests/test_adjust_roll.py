"""Roll of blocks over one strip: what holds it, how well, and what is refused."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from survey.adjust.block.roll import rolls_of
from survey.adjust.block.state import NUM_POSE
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Adjustment
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.sfm.gps_fit import LineAxes, PositionLine, roll_by_attitudes, roll_by_control, roll_by_ground
from tests.block_survey import survey_of
from tests.changed_survey import changed
from tests.drawn_block import DrawnBlock, _turned, draw_block

POSITION_STD_M = (0.5, 0.5, 0.8)
# Of the start, and of what attitudes have in common and of their own.
START_DEG, ATTITUDE_DEG, OWN_DEG = 3.0, 1.0, 0.3


def strip(seed: int, **settings) -> tuple[DrawnBlock, Survey, LineAxes]:
    """A block over one strip with GPS alone, rolled from its true place, and the line of its positions."""
    rng = np.random.default_rng([seed, 77])
    sizes = {"num_views": 14 + seed % 8, "num_points": 200, "height": float(rng.uniform(15.0, 40.0))}
    block = draw_block(seed, strip=True, nadir_only=True, position_std=POSITION_STD_M, **(sizes | settings))
    survey = survey_of(block)
    (roll,) = rolls_of(survey)
    turn = roll.across.rolled(math.radians(rng.normal(0.0, START_DEG))).rotation
    views = tuple(
        replace(view, camera=view.lens.camera(view.camera.centre, view.camera.cam_from_local @ turn.T))
        for view in survey.views
    )
    return block, replace(survey, views=views), roll.across


def with_attitudes(block: DrawnBlock, survey: Survey, own_deg: float = OWN_DEG) -> Survey:
    """The survey with attitudes of its cameras, off by an error in common and one of their own."""
    rng = np.random.default_rng([block.seed, 78])
    common = Rotation.from_rotvec(np.radians(rng.normal(0.0, ATTITUDE_DEG, 3))).as_matrix()
    priors = {
        view.name: replace(
            survey.observations.priors[view.name],
            # About the axes of local: in those of cam it would cancel between photographs of opposite headings.
            attitude=_turned(camera.cam_from_local, np.radians(rng.normal(0.0, own_deg, 3))) @ common,
        )
        for view, camera in zip(survey.views, block.cameras, strict=True)
    }
    return changed(survey, priors=priors)


def roll_error(block: DrawnBlock, found: Adjustment, across: LineAxes) -> tuple[float, float]:
    """Error of the roll about the line and its standard deviation [rad]."""
    true = np.array([camera.cam_from_local for camera in block.cameras])
    mean = np.zeros(len(found.covariance.matrix))
    mean[-NUM_POSE * len(true) :].reshape(-1, NUM_POSE)[:, 3:] = found.poses.rotations @ across.along / len(true)
    return roll_by_attitudes(across, found.poses.rotations, true), math.sqrt(mean @ found.covariance.matrix @ mean)


def test_one_control_point_holds_the_roll():
    block, survey, across = strip(13, num_control=1, dry_share=0.5)
    found = adjust_survey(survey, use_windows=False)
    error, std = roll_error(block, found, across)
    assert abs(error) < 3.0 * std
    assert std < math.radians(0.5)
    assert any("the roll about it is known to" in note and "control (gcp0)" in note for note in found.notes)


@pytest.mark.parametrize("has_water", [True, False])
def test_a_roll_that_level_water_holds_at_most_is_refused_and_says_what_would_hold_it(has_water):
    """Weak priors of many photographs would add up to what looks like knowledge, and a curvature too."""
    _, survey, _ = strip(4, num_control=0)
    if not has_water:
        survey = replace(survey, water=None, config=replace(survey.config, water=None))
    with pytest.raises(SurveyError, match=r"neither control nor attitudes hold the roll .* give control beside"):
        adjust_survey(survey, use_windows=False)


def test_attitudes_hold_the_roll_as_well_as_they_are_stated():
    block, survey, across = strip(3, num_control=0)
    survey = with_attitudes(block, survey)
    priors = {name: replace(prior, attitude_std_deg=0.1) for name, prior in survey.observations.priors.items()}
    found = adjust_survey(changed(survey, priors=priors), use_windows=False)
    _, std = roll_error(block, found, across)
    assert 0.3 * math.radians(0.1) < std < 1.02 * math.radians(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["control", "controls", "attitudes"])
def test_the_standard_deviation_of_the_roll_covers_its_error(monkeypatch, kind):
    monkeypatch.setattr("survey.adjust.observability.max_height_std", lambda _gsd: math.inf)
    scaled = []
    for seed in range(24):
        num = {"control": 1, "controls": 3, "attitudes": 0}[kind]
        block, survey, across = strip(seed, num_control=num, **({"dry_share": 0.5} if num else {}))
        survey = with_attitudes(block, survey) if kind == "attitudes" else survey
        error, std = roll_error(block, adjust_survey(survey, use_windows=False), across)
        scaled.append(error / std)
    # The mean square of 24 normal deviates is within 0.45 and 1.8 in 99.7 % of all cases.
    assert 0.45 < np.mean(np.square(scaled)) < 1.8
    assert np.mean(np.abs(scaled) < 1.96) > 0.8


@pytest.mark.parametrize("angle", [-2.5, -0.3, 0.0, 0.1, 3.0])
def test_attitudes_control_and_ground_find_an_angle(rng, angle):
    direction = np.array([1.0, 0.4, 0.05]) / np.linalg.norm([1.0, 0.4, 0.05])
    across = LineAxes.of(PositionLine(np.array([3.0, 2.0, 30.0]), direction, 50.0, 0.1, 0.1))
    down = Rotation.from_euler("x", 180.0, degrees=True).as_matrix()
    true = np.array([_turned(down, rng.normal(0.0, 0.01, 3)) for _ in range(40)])
    points = np.column_stack([rng.uniform(-30.0, 30.0, (50, 2)), rng.normal(0.0, 0.2, 50)])
    away = across.rolled(-angle)
    rolled, moved = true @ away.rotation.T, away(points)
    assert roll_by_attitudes(across, rolled, true) == pytest.approx(angle, abs=1e-9)
    assert roll_by_control(across, moved, points) == pytest.approx(angle, abs=1e-9)
    off = roll_by_ground(across, rolled, moved) - angle
    # Shaken by 0.01 each.
    assert (off + math.pi) % (2.0 * math.pi) - math.pi == pytest.approx(0.0, abs=0.01)
