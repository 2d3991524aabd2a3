"""What an adjustment writes is read back as it was, by this program and as poses of others."""

from __future__ import annotations

import numpy as np
import pytest

from survey.adjust.applied import CAMERAS, apply_adjustment, write_cameras
from survey.adjust.refine import adjust_survey
from survey.adjust.result.adjustment import read_adjustment, write_adjustment
from survey.errors import SurveyError
from survey.photos.poses import PoseFrame
from survey.pose_files import read_poses, read_ties
from tests.adjusted_block import assert_same
from tests.block_survey import survey_of
from tests.drawn_block import draw_block


@pytest.fixture(scope="module")
def adjusted():
    survey = survey_of(draw_block(3, num_points=60, num_views=12, dry_share=0.35))
    return survey, adjust_survey(survey, use_windows=False)


def test_an_adjustment_is_read_as_it_was_written(adjusted, tmp_path):
    _, found = adjusted
    write_adjustment(tmp_path, found)
    assert_same(read_adjustment(tmp_path), found)
    assert found.control, "a block without control would not show that control is read"
    assert found.statistics.gps_std_m is not None


def test_a_folder_without_an_adjustment_is_refused(tmp_path):
    with pytest.raises(SurveyError, match="has no adjustment"):
        read_adjustment(tmp_path)


def test_cameras_csv_and_the_colmap_model_have_the_adjusted_poses(adjusted, tmp_path):
    survey, found = adjusted
    applied = apply_adjustment(survey, found)
    write_cameras(tmp_path, applied, found)
    by_table, by_model = read_poses(tmp_path / CAMERAS), read_poses(tmp_path / "sparse")
    assert (by_table.frame, by_model.frame) == (PoseFrame.GRID, PoseFrame.LOCAL)
    # Both are poses of an adjustment with bent rays, which no warning of straight ones fits.
    assert (by_table.tool, by_model.tool) == (None, None)
    in_crs, in_local = by_table.poses, by_model.poses
    centres = np.array([pose.centre for pose in in_crs])
    local_from_grid = survey.frame.local_from_grid(centres)
    # The file has hundredths of a millimetre and 1e-8 degrees.
    np.testing.assert_allclose(survey.frame.local_from_crs(centres), found.poses.centres, atol=2e-5)
    for number, (first, second, view) in enumerate(zip(in_crs, in_local, applied.views, strict=True)):
        assert first.name == second.name == view.name
        rotation = first.cam_from_world @ local_from_grid[number].T
        np.testing.assert_allclose(rotation, view.camera.cam_from_local, atol=1e-9)
        np.testing.assert_allclose(second.cam_from_world, view.camera.cam_from_local, atol=1e-12)
        np.testing.assert_allclose(second.centre, view.camera.centre, atol=1e-9)
        assert second.lens == view.lens


def test_the_points_of_the_model_are_where_straight_rays_meet_with_their_tracks(adjusted, tmp_path):
    survey, found = adjusted
    applied = apply_adjustment(survey, found)
    write_cameras(tmp_path, applied, found)
    ties = read_ties(tmp_path / "sparse")
    assert ties is not None
    assert ties.names == tuple(view.name for view in applied.views)
    # All points but those that fewer than three photographs show.
    counts = np.bincount(found.residuals.point, minlength=len(found.points))
    np.testing.assert_array_equal(ties.num_views, counts[counts >= 3])
    np.testing.assert_array_equal(np.bincount(ties.point), ties.num_views)
    true = found.points[counts >= 3]
    dry = np.asarray(applied.water.depth(true)) <= 0.0
    assert 3 < dry.sum() < len(true) - 3
    np.testing.assert_allclose(ties.points[dry], true[dry], atol=0.02)
    # A bed looks a quarter less deep, and more from the side.
    share = np.asarray(applied.water.depth(ties.points[~dry])) / np.asarray(applied.water.depth(true[~dry]))
    assert 0.55 < np.quantile(share, 0.05) < np.quantile(share, 0.95) < 0.77
    # Straight rays to them fall nearer to the pixels than those to the true places.

    def misses(places: np.ndarray) -> np.ndarray:
        pixels = [view.camera.project(places, None) for view in applied.views]
        return np.linalg.norm(np.array(pixels)[ties.image, ties.point] - ties.pixel, axis=1)

    assert np.median(misses(ties.points)) < 0.2 * np.median(misses(true))
