"""A run that is watched while it is processed: maps as they come, then the cloud; the result is the same."""

from __future__ import annotations

import threading
from types import SimpleNamespace

import numpy as np
import pytest
from drawn_runs import drawn, process_quietly
from small_survey import small_survey

from fields.sweep.maps import HeightMap
from geo.las import read_cloud
from survey.folder.survey import load_survey
from survey.photos.images import ImageStore, load_image
from survey.run.flight import load_flight
from survey.run.folder import RunDir
from survey.run.stored import load_arrays
from survey.run.stored_maps import LIVE, LiveMaps
from survey.viewer.page import close_server, open_server
from survey.viewer.session import LiveRun


@pytest.fixture
def server():
    server = open_server("localhost", 0, "test")
    yield server
    close_server(server)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_points_of_a_map_lie_where_its_heights_are(tmp_path, scale):
    survey = load_survey(small_survey(tmp_path / "s"))
    camera = survey.views[0].camera.scaled(scale)
    shape = (camera.height, camera.width)
    score = np.ones(shape, dtype=np.float16)
    score[:, : camera.width // 2] = 0.1
    job = SimpleNamespace(survey=survey, plan=SimpleNamespace(image_scale=1.0), photographs=ImageStore())
    job.block = SimpleNamespace(cameras=[view.camera for view in survey.views])
    job.in_survey = lambda places: places
    job.survey_job = job
    live = LiveMaps(tmp_path, job, "sweep")
    m = HeightMap(0, np.full(shape, -0.7, dtype=np.float32), score, np.zeros(shape, dtype=np.uint8), 0.0 * score)
    live.show(m)
    assert not (tmp_path / LIVE).exists()
    (tmp_path / LIVE).mkdir()
    live.show(m)
    arrays = load_arrays(tmp_path / LIVE / "sweep-0.npz")
    # float32 heights.
    np.testing.assert_allclose(survey.water.depth(arrays["xyz"]), 0.7, atol=1e-6)
    pixels = survey.views[0].camera.project(arrays["xyz"], survey.water)
    assert (pixels[:, 0] > 0.5 * survey.views[0].camera.width).all()
    image = load_image(survey.views[0])
    u, v = np.floor(pixels + 1e-6).astype(int).T
    np.testing.assert_array_equal(arrays["rgb"], image[v, u])
    assert len(load_flight(tmp_path / LIVE).views) == len(survey.views)


def test_a_viewer_goes_on_when_another_one_of_the_run_closes(tmp_path, server):
    with RunDir(tmp_path / "run"):
        pass
    first, second = (LiveRun(RunDir(tmp_path / "run"), server) for _ in range(2))
    second.close()
    assert first.show_new_maps() == 0
    assert (tmp_path / "run" / LIVE).is_dir()
    # A map that is gone before it is read.
    (tmp_path / "run" / LIVE / "sweep-0.npz").symlink_to("nowhere")
    first._cameras = SimpleNamespace()
    assert first.show_new_maps() == 0
    first.close()


@pytest.mark.slow
def test_maps_are_shown_as_they_come_and_change_nothing(tmp_path, server):
    alone, watched = drawn(tmp_path / "alone"), drawn(tmp_path / "watched")
    assert process_quietly(alone.folder) == 0
    # As `process` has it before the sweep.
    with RunDir(watched.run.path):
        pass
    live = LiveRun(watched.run, server)
    assert live.show_new_maps() == 0
    work = threading.Thread(target=process_quietly, args=(watched.folder,))
    work.start()
    shown = 0
    while work.is_alive():
        shown += live.show_new_maps()
        work.join(0.1)
    live.show_new_maps()
    assert live.is_finished
    assert shown >= len(watched.survey.views)
    maps = [node for node in server.scene._handle_from_node_name if node.startswith("/maps/")]
    assert len(maps) > 5
    # What was shown lies on the bed: nine in ten points within a few ground sampling distances of its heights.
    heights = read_cloud(watched.run.cloud_path).points[:, 2] - watched.survey.frame.origin[2]
    for path in (watched.run.path / LIVE).glob("*.npz"):
        z = load_arrays(path)["xyz"][:, 2]
        assert ((z > heights.min() - 0.1) & (z < heights.max() + 0.1)).mean() > 0.9
    live.close()
    assert not (watched.run.path / LIVE).exists()
    np.testing.assert_array_equal(read_cloud(alone.run.cloud_path).points, read_cloud(watched.run.cloud_path).points)
