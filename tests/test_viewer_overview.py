"""The cloud from above, the ground of a screen, the grid of coordinates, and key frames of a flight."""

from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from shown_run import shown_of

from refract import PinholeCamera
from survey.folder.local_frame import poses_in_local
from survey.pose_files import read_poses
from survey.viewer.overview import add_scale, footprint, grid_lines, overview, write_key_frames
from survey.viewer.shown import MARKED, Style


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    return shown_of(tmp_path_factory.mktemp("overview") / "s")


def test_the_overview_has_north_up_and_the_colours_of_the_cloud(shown):
    share = (shown.tree.points - shown.low)[:, :2] / (shown.high - shown.low)[:2]
    shown.mark(np.flatnonzero((share[:, 0] < 0.2) & (share[:, 1] > 0.8)))
    picture = cv2.imdecode(np.frombuffer(overview(shown, Style()), np.uint8), cv2.IMREAD_UNCHANGED)
    shown.mark(np.empty(0, dtype=np.int64))
    marked = (picture[..., :3] == MARKED[::-1]).all(axis=-1)
    assert marked[:20, :20].any()
    assert not marked[picture.shape[0] // 2 :].any()
    assert not marked[:, picture.shape[1] // 2 :].any()


def test_a_cloud_without_width_has_no_bar(shown):
    low = shown.middle
    add_scale(None, SimpleNamespace(low=low, high=low + np.array([0.0, 3.0, 1.0]), middle=low))


def test_the_ground_of_a_screen_is_where_its_corners_look(shown):
    wide, tall = (shown.high - shown.low)[:2]
    # From above the middle, half of the width of the cloud on the screen; what is up is north.
    height = 10.0
    camera = PinholeCamera(
        shown.middle + np.array([0.0, 0.0, height]), np.diag([1.0, -1.0, -1.0]), 400.0 * height / (0.25 * wide),
        400.0 * height / (0.25 * wide), 400.0, 300.0, 800, 600,
    )  # fmt: skip
    half = 0.25 * wide * 0.75 / tall
    expected = [[0.25, 0.5 + half], [0.75, 0.5 + half], [0.75, 0.5 - half], [0.25, 0.5 - half]]
    np.testing.assert_allclose(footprint(shown, camera), expected, atol=1e-9)


def test_lines_of_the_grid_have_the_coordinates_that_they_say(shown):
    lines = grid_lines(shown)
    for text, ends in lines:
        crs = shown.flight.frame.crs_from_local(ends)
        axis = int(np.argmin(np.abs(np.diff(crs[:, :2], axis=0))))
        np.testing.assert_allclose(crs[:, axis], float(text), atol=1e-6)
    assert len({text for text, _ in lines}) == len(lines) >= 6


def test_key_frames_are_cameras_for_render(shown, tmp_path):
    camera = shown.views[1].camera
    write_key_frames(tmp_path / "edits" / "flight.csv", shown, [camera, shown.views[0].camera])
    file = read_poses(tmp_path / "edits" / "flight.csv")
    assert [pose.name for pose in file.poses] == ["view000", "view001"]
    centres, rotations = poses_in_local(file, tmp_path, shown.flight.frame, "crs")
    np.testing.assert_allclose(centres[0], camera.centre, atol=1e-5)
    np.testing.assert_allclose(rotations[0], camera.cam_from_local, atol=1e-8)
    write_key_frames(tmp_path / "edits" / "flight.csv", shown, [])
    assert not (tmp_path / "edits" / "flight.csv").exists()
