"""A block placed on the dry ground of an earlier survey: against known shifts, and on ground that changed."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from survey.adjust.block.on_ground import GroundFit, shift_onto, ties_on_ground
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import read_adjustment, write_adjustment
from survey.control.points import StableGround
from survey.errors import ControlError
from tests.block_survey import height_error, pose_errors
from tests.changed_survey import changed
from tests.drawn_ground import drawn_on_ground, with_stated_positions


def rough(rng: np.random.Generator, count: int, half: float = 15.0) -> np.ndarray:
    """Points on a slope with relief of 0.3 m, some metres long."""
    places = rng.uniform(-half, half, (count, 2))
    waves = np.random.default_rng(36).normal(0.0, 0.8, (8, 2))
    height = 0.1 * places[:, 0] + 0.15 * np.sin(places @ waves.T + np.arange(8.0)).sum(axis=1)
    return np.column_stack([places, height])


@settings(max_examples=6)
@given(seed=st.integers(0, 2**32 - 1), shift=st.tuples(*[st.floats(-4.0, 4.0)] * 2, st.floats(-50.0, 50.0)))
def test_a_shift_is_found_from_points_of_which_a_fifth_is_wrong(seed, shift):
    rng = np.random.default_rng(seed)
    points = rough(rng, 300, half=8.0)
    points[:60, 2] += rng.uniform(-2.0, 3.0, 60)
    found = shift_onto(StableGround(rough(rng, 6000), (0.1, 0.1)), points - shift)
    assert np.abs(found - shift).max() < 0.05


def test_planes_hold_points_of_the_ground_and_leave_out_what_changed():
    rng = np.random.default_rng(3)
    points = np.concatenate([rough(rng, 400, half=14.0), rough(rng, 5)])
    points[:40, 2] += 0.7
    points[40:60, 0] += 100.0
    on_ground = ties_on_ground(StableGround(rough(rng, 8000), (0.1, 0.1)), points, 400)
    used = on_ground.planes.precision > 0.0
    assert not used[:60].any()
    assert not used[400:].any()
    assert on_ground.changed[:40].mean() > 0.9
    assert not on_ground.changed[40:60].any()
    assert on_ground.changed[60:400].mean() < 0.05
    assert np.abs(on_ground.planes.distances(points, np.zeros(3))[used]).max() < 0.06
    with pytest.raises(ControlError, match="tie points lie over the dry ground"):
        ties_on_ground(StableGround(rough(rng, 8000) + np.array([100.0, 0.0, 0.0]), (0.1, 0.1)), points[:40], 40)


def test_a_block_off_by_half_a_metre_comes_to_where_the_bank_is(tmp_path):
    block, survey = drawn_on_ground(5, std_m=(0.01, 0.01), num_points=400)
    found = adjust_survey(survey, use_windows=False)
    fit = found.ground
    off, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert np.abs(off.mean(axis=0)).max() < 0.1
    assert abs(height_error(block, found)) < 0.05
    assert np.allclose(fit.moved[:3], (-0.4, 0.3, -0.5), atol=0.1)
    assert max(fit.std[:3]) < 0.05 < min(fit.std_without[:2])
    assert all(fit.is_determined_by_ground[:2])
    assert "placed on" in " ".join(found.notes)
    write_adjustment(tmp_path, found)
    assert read_adjustment(tmp_path).ground == fit


def test_good_positions_stay_good_beside_an_earlier_survey():
    block, survey = drawn_on_ground(6, std_m=(0.01, 0.01), shift=(0.0, 0.0, 0.0), num_points=400)
    found = adjust_survey(with_stated_positions(block, survey), use_windows=False)
    off, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert off.std(axis=0).max() < 0.04
    assert abs(height_error(block, found)) < 0.05
    assert max(found.ground.std_without[:3]) < 0.05
    assert found.ground.warnings == ()


def test_positions_of_two_centimetres_overrule_an_earlier_survey_of_ten():
    block, survey = drawn_on_ground(6, std_m=(0.1, 0.1), shift=(0.0, 0.0, 0.0), num_points=300)
    ground = survey.observations.ground
    lifted = replace(ground, points=ground.points + np.array([0.0, 0.0, 0.2]))
    fits = [
        adjust_survey(changed(with_stated_positions(block, survey), ground=each), use_windows=False).ground
        for each in (ground, lifted)
    ]
    # Two observations of one height combine by their weights: the earlier survey, and all else.
    without, both = fits[0].std_without[2], fits[0].std[2]
    assert both == pytest.approx((without**-2 + 0.1**-2) ** -0.5, rel=0.03)
    share = both**2 / 0.1**2
    assert fits[1].moved[2] - fits[0].moved[2] == pytest.approx(0.2 * share, abs=0.003)
    assert fits[1].off_m[2] - fits[0].off_m[2] == pytest.approx(0.2 * (1.0 - share), abs=0.003)
    assert "all of earlier.las is off by" in " ".join(fits[1].notes)


def test_an_earlier_survey_farther_off_than_it_says_is_warned_of():
    std = (0.02,) * 7
    fit = GroundFit(
        reference="earlier.las", num_points=90, num_over=120, num_changed=3, rms_m=0.03, scatter=1.0, moved=(0.0,) * 7,
        std=std, std_without=std, is_against_positions=False, off_m=(0.0, 0.01, 0.3), off_std_m=std[:3],
        off_prior_m=(0.05,) * 3,
    )  # fmt: skip
    (warning,) = fit.warnings
    assert "earlier.las lies 300" in warning
    assert "further up than control and positions place it" in warning
    assert replace(fit, off_prior_m=(0.1,) * 3).warnings == ()
    assert "all of earlier.las is off by" in fit.notes[0]


@pytest.mark.slow
def test_intervals_of_blocks_with_good_positions_hold_what_they_say():
    errors = []
    for seed in range(200, 220):
        shift = np.random.default_rng(seed).normal(0.0, (0.02, 0.02, 0.03))
        block, survey = drawn_on_ground(seed, std_m=(0.1, 0.1), shift=tuple(shift), num_points=400)
        found = adjust_survey(with_stated_positions(block, survey), use_windows=False)
        errors.append(height_error(block, found) / found.ground.std[2])
    # Of 20 deviates of unit standard deviation the root mean square lies within 1 +- 0.32 in 95 of 100 cases.
    assert 0.5 < np.sqrt(np.mean(np.square(errors))) < 1.35


@pytest.mark.slow
def test_intervals_of_placed_blocks_hold_what_they_say():
    """Over flat and rough banks, with a quarter of the ground changed in every other one."""
    inside = []
    for seed in range(100, 124):
        block, survey = drawn_on_ground(seed, changed_share=0.25 * (seed % 2), shift=(1.0, -0.8, -1.5))
        found = adjust_survey(survey, use_windows=False)
        error = (*(found.ground.moved[:2] + np.array([1.0, -0.8])), height_error(block, found))
        inside.append(np.abs(error) <= 1.96 * np.array(found.ground.std[:3]))
    assert np.mean(inside) >= 0.85
