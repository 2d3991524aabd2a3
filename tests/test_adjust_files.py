"""What an adjustment writes is read back as it was, by this program and as poses of others."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from survey.adjust.adjustment import read_adjustment, write_adjustment
from survey.adjust.refine import adjust_survey, apply_adjustment
from survey.adjust.written import CAMERAS, write_cameras
from survey.errors import SurveyError
from survey.photos.formats import read_poses
from survey.photos.poses import PoseFrame
from tests.block_survey import survey_of
from tests.drawn_block import draw_block


@pytest.fixture(scope="module")
def adjusted():
    survey = survey_of(draw_block(3, num_points=60, num_views=12, dry_share=0.35))
    return survey, adjust_survey(survey, use_windows=False)


def test_an_adjustment_is_read_as_it_was_written(adjusted, tmp_path):
    _, found = adjusted
    write_adjustment(tmp_path, found)
    again = read_adjustment(tmp_path)
    for field in fields(found):
        value, expected = getattr(again, field.name), getattr(found, field.name)
        if isinstance(expected, np.ndarray):
            np.testing.assert_array_equal(value, expected, err_msg=field.name)
        else:
            assert value == expected, field.name
    assert found.control, "a block without control would not show that control is read"
    assert found.gps_std_m is not None


def test_a_folder_without_an_adjustment_is_refused(tmp_path):
    with pytest.raises(SurveyError, match="has no adjustment"):
        read_adjustment(tmp_path)


def test_cameras_csv_and_the_colmap_model_have_the_adjusted_poses(adjusted, tmp_path):
    survey, found = adjusted
    applied = apply_adjustment(survey, found)
    write_cameras(tmp_path, applied)
    by_table, by_model = read_poses(tmp_path / CAMERAS), read_poses(tmp_path / "sparse")
    assert (by_table.frame, by_model.frame) == (PoseFrame.GRID, PoseFrame.LOCAL)
    # Both are poses of an adjustment with bent rays, which no warning of straight ones fits.
    assert (by_table.tool, by_model.tool) == (None, None)
    in_crs, in_local = by_table.poses, by_model.poses
    centres = np.array([pose.centre for pose in in_crs])
    local_from_grid = survey.frame.local_from_grid(centres)
    # The file has hundredths of a millimetre and 1e-8 degrees.
    np.testing.assert_allclose(survey.frame.local_from_crs(centres), found.centres, atol=2e-5)
    for number, (first, second, view) in enumerate(zip(in_crs, in_local, applied.views, strict=True)):
        assert first.name == second.name == view.name
        rotation = first.cam_from_world @ local_from_grid[number].T
        np.testing.assert_allclose(rotation, view.camera.cam_from_local, atol=1e-9)
        np.testing.assert_allclose(second.cam_from_world, view.camera.cam_from_local, atol=1e-12)
        np.testing.assert_allclose(second.centre, view.camera.centre, atol=1e-9)
        assert second.lens == view.lens
