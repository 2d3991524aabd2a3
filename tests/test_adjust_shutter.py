"""Rolling shutters in the adjustment: predictions, derivatives, blocks flown in all directions, and their readout."""

from dataclasses import replace

import numpy as np
import pytest

from refract.lens import Lens, distorted, undistorted
from survey.adjust.applied import apply_adjustment
from survey.adjust.block.observed import original_rows
from survey.adjust.block.prediction import predict
from survey.adjust.block.state import NUM_LENS, NUM_RELIEF
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import Status, read_adjustment, write_adjustment
from survey.adjust.result.parts import common_error
from survey.photos.poses import TiePoints
from tests.block_survey import assert_same, pose_errors, require_derivatives, rms, state_of, survey_of
from tests.drawn_block import DrawnBlock, draw_block

READOUT = 0.03
FLOWN = {"num_points": 300, "num_views": 16, "nadir_only": False, "dry_share": 0.3, "num_control": 6,
         "speed": 5.0, "readout": READOUT, "pixel_std": 0.15, "height": 22.0}  # fmt: skip


def test_predictions_are_the_pixels_of_cameras_that_fly_on_while_they_are_read_out():
    layout, state, ties = state_of(draw_block(2, **FLOWN | {"pixel_std": 1e-9}), rolls=True)
    rise_design = np.zeros((len(ties.view), NUM_RELIEF))
    np.testing.assert_allclose(predict(layout, state, ties, rise_design), ties.pixel, atol=1e-6)
    still = predict(replace(layout, velocity_per_row=None), state, ties, rise_design)
    assert np.abs(still - ties.pixel).max() > 1.0


@pytest.mark.parametrize("finds_readouts", [False, True])
def test_derivatives_with_a_rolling_shutter_are_those_of_differences(finds_readouts):
    block = draw_block(2, **FLOWN | {"num_points": 30, "num_views": 8})
    layout, state, ties = state_of(block, rolls=True, finds_readouts=finds_readouts)
    assert len(layout) == 4 + NUM_RELIEF + 2 * NUM_LENS + 2 * finds_readouts + 6 * 8
    require_derivatives(layout, state, ties)


def adjusted(block: DrawnBlock, shutter):
    survey = survey_of(block, shutter=shutter)
    return survey, adjust_survey(survey, use_windows=False)


@pytest.mark.slow
def test_with_the_key_poses_are_as_good_as_with_a_global_shutter_and_without_it_they_are_not():
    still = draw_block(6, **FLOWN | {"speed": 0.0})
    _, of_still = adjusted(still, None)
    block = draw_block(6, **FLOWN)
    survey, known = adjusted(block, (READOUT, None))
    _, ignored = adjusted(block, None)
    errors = [pose_errors(block, found.poses.centres, found.poses.rotations)[0] for found in (of_still, known, ignored)]
    # Other noise: 11.9, 12.5 and 374 mm.
    assert rms(errors[1]) < 1.3 * rms(errors[0])
    assert rms(errors[2]) > 5.0 * rms(errors[1])
    assert rms(errors[1] / known.poses.position_std) < 1.3
    assert rms(errors[2] / ignored.poses.position_std) > 2.0
    # A shutter that is not modelled leaves its mark in the residuals.
    assert known.statistics.std_px["matches"] == pytest.approx(of_still.statistics.std_px["matches"], rel=0.1)
    assert ignored.statistics.std_px["matches"] > 2.0 * known.statistics.std_px["matches"]
    moved = apply_adjustment(survey, known)
    for view, velocity in zip(moved.views, block.velocities, strict=True):
        np.testing.assert_allclose(view.camera.motion, velocity * READOUT / (block.lens.height - 1), rtol=1e-12)
    assert common_error(known, moved.water).mean == pytest.approx(common_error(of_still, moved.water).mean, rel=0.1)


def test_the_readout_is_found_where_it_is_not_known_within_what_is_stated(tmp_path):
    block = draw_block(4, **FLOWN)
    survey, found = adjusted(block, (0.02, 0.02))
    row = found.parameter("camera0.readout_s")
    assert row.status == Status.FREE
    assert row.std < 1e-3
    assert abs(row.value - READOUT) < 3.0 * row.std
    assert row.verdict.startswith("found: 0.0")
    at = found.covariance.names.index("camera0.readout_s")
    assert np.sqrt(found.covariance.matrix[at, at]) == pytest.approx(row.std)
    assert len(found.covariance.names) == len(found.covariance.matrix)
    # What was found is what everything behind the adjustment uses.
    moved = apply_adjustment(survey, found)
    cameras = moved.config.cameras
    assert (cameras.rolling_shutter_s, cameras.rolling_shutter_std_s) == (row.value, None)
    np.testing.assert_allclose(
        [view.camera.motion for view in moved.views], block.velocities * row.value / (block.lens.height - 1)
    )
    assert common_error(found, moved.water).mean > 0.0
    write_adjustment(tmp_path, found)
    again = read_adjustment(tmp_path)
    np.testing.assert_array_equal(again.poses.velocity_per_row, found.poses.velocity_per_row)
    assert (again.readouts_s, again.parameter(row.name)) == (found.readouts_s, row)


def test_a_slow_flight_does_not_tell_the_readout():
    _, found = adjusted(draw_block(4, **FLOWN | {"speed": 0.05, "num_points": 120}), (READOUT, 0.005))
    row = found.parameter("camera0.readout_s")
    assert row.status == Status.HELD
    assert row.value == pytest.approx(READOUT, abs=0.003)


def test_a_readout_that_is_of_no_use_is_kept_as_given_and_the_block_adjusted_to_it(monkeypatch):
    monkeypatch.setattr("survey.adjust.result.adjustment.MOST_STD_ROWS_PX", 1e-6)
    _, found = adjusted(draw_block(4, **FLOWN), (0.02, 0.02))
    row = found.parameter("camera0.readout_s")
    assert (row.status, row.value) == (Status.UNKNOWN, 0.02)
    assert found.readouts_s == pytest.approx((0.02,), abs=1e-9)
    at = found.covariance.names.index(row.name)
    assert np.sqrt(found.covariance.matrix[at, at]) == pytest.approx(0.02)


def test_a_camera_that_hovers_is_adjusted_to_the_last_bit_as_without_the_key():
    block = draw_block(4, **FLOWN | {"speed": 0.0, "num_points": 120})
    _, without = adjusted(block, None)
    for shutter in ((READOUT, None), (READOUT, 0.01)):
        _, found = adjusted(block, shutter)
        assert (found.poses.velocity_per_row, found.readouts_s) == (None, None)
        assert_same(found, without)


def test_rows_behind_a_lens_that_is_held_are_those_of_the_photograph(rng):
    fisheye = Lens("OPENCV_FISHEYE", (300.0, 300.0, 320.0, 240.0, 0.01, 0.0, 0.0, 0.0), 640, 480)
    taken = rng.uniform([40.0, 40.0], [600.0, 440.0], (20, 2))
    seen = undistorted(fisheye, taken) * fisheye.focal + (fisheye["cx"], fisheye["cy"])
    ties = TiePoints(np.zeros((20, 3)), np.arange(20), np.arange(20) % 2, seen)
    plain = Lens("PINHOLE", (300.0, 300.0, 320.0, 240.0), 640, 480)
    rows = original_rows(ties, (fisheye, plain), np.array([0, 1]))
    np.testing.assert_allclose(rows[::2], taken[::2, 1], atol=1e-6)
    np.testing.assert_array_equal(rows[1::2], seen[1::2, 1])
    assert np.abs(rows - distorted(plain, seen)[:, 1])[::2].max() > 5.0
