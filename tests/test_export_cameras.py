"""Cameras of a run for other programs: pycolmap and the formula of nerfstudio see what ours see without water."""

import json
from dataclasses import replace

import numpy as np
import pytest
from small_survey import small_survey
from stored_run import plane_stored, run_of

from refract.lens import Lens
from survey.errors import OutputError, SurveyError
from survey.export.export import export
from survey.folder.survey import load_survey
from survey.pose_files import read_poses
from survey.run.flight import FLIGHT, load_flight, save_flight

LENSES = {
    "brown": Lens("FULL_OPENCV", (101.3, 101.2, 31.7, 24.4, 0.02, -0.01, 1e-4, -2e-4, 0.003, 0.0, 0.0, 0.0), 64, 48),
    "metashape": Lens("BROWN_AFFINE", (101.3, 101.2, 31.7, 24.4, 0.02, -0.01, 1e-4, -2e-4, 0.003, 0.0, 0.0), 64, 48),
    "pinhole": Lens("SIMPLE_PINHOLE", (100.0, 32.0, 24.0), 64, 48),
}
BESIDE = {
    "skewed": Lens("BROWN_AFFINE", (*LENSES["metashape"].params[:-1], 1e-4), 64, 48),
    "rational": Lens("FULL_OPENCV", (*LENSES["brown"].params[:-1], 1e-3), 64, 48),
}


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    """A cloud, and the survey that it belongs to."""
    folder = tmp_path_factory.mktemp("block") / "small"
    return plane_stored(folder), load_survey(small_survey(folder))


@pytest.fixture
def run(block, tmp_path):
    """A run whose views look 20 degrees off nadir; a function that gives them another lens."""
    stored, survey = block
    path = run_of(stored, tmp_path / "run")

    def with_lens(lens: Lens):
        c, s = np.cos(0.35), np.sin(0.35)
        tilt = np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]])
        views = [
            replace(
                view,
                lens=lens,
                camera=replace(lens.camera(view.camera.centre, tilt @ view.camera.cam_from_local), tide=0.1 * number),
            )
            for number, view in enumerate(survey.views)
        ]
        save_flight(path, replace(survey, views=tuple(views)))
        return path, views, stored

    return with_lens


def points_before(camera) -> np.ndarray:
    """Points that a camera sees, all over its image."""
    pixels = np.array([[5.0, 7.0], [60.0, 4.0], [32.0, 24.0], [9.0, 44.0], [57.5, 41.0]])
    return camera.paths(pixels, None).at_height(np.linspace(-1.0, 1.0, len(pixels)), None)


def test_a_flight_comes_back_as_it_was(run, block):
    path, views, _ = run(LENSES["brown"])
    again = load_flight(path)
    survey = block[1]
    assert (again.water, again.bounds, again.frame.origin) == (survey.water, survey.bounds, survey.frame.origin)
    for one, other in zip(again.views, views, strict=True):
        assert (one.name, one.lens, one.path) == (other.name, other.lens, other.path.absolute())
        assert one.camera.tide == other.camera.tide
        np.testing.assert_array_equal(one.camera.centre, other.camera.centre)
        np.testing.assert_array_equal(one.camera.cam_from_local, other.camera.cam_from_local)


@pytest.mark.parametrize("kind", LENSES)
def test_pycolmap_projects_with_the_exported_model_as_we_do(run, tmp_path, kind):
    pycolmap = pytest.importorskip("pycolmap")
    path, views, stored = run(LENSES[kind])
    export(path, colmap=tmp_path / "model")
    model = pycolmap.Reconstruction(tmp_path / "model")
    images = {image.name: image for image in model.images.values()}
    assert set(images) == {view.name for view in views}
    for view in views:
        points = points_before(view.camera)
        theirs = [images[view.name].project_point(point) for point in points]
        np.testing.assert_allclose(theirs, view.camera.project(points, None), atol=1e-6)
    assert len(model.points3D) == len(stored.bed)
    first = min(model.points3D)
    np.testing.assert_allclose(model.points3D[first].xyz, stored.bed.xyz[0], atol=1e-4)


def test_nerfstudio_cameras_look_where_ours_do(run, tmp_path):
    path, views, _ = run(LENSES["brown"])
    export(path, nerfstudio=tmp_path / "transforms.json")
    said = json.loads((tmp_path / "transforms.json").read_text(encoding="utf-8"))
    for view, frame in zip(views, said["frames"], strict=True):
        assert frame["file_path"].endswith(view.name)
        points = points_before(view.camera)
        world_to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
        right, up, back = world_to_camera[:3] @ np.column_stack([points, np.ones(len(points))]).T
        # nerfstudio's OPENCV: x to the right, y down after the division by the depth, which is -z.
        x, y = right / -back, up / back
        r2 = x * x + y * y
        radial = 1.0 + r2 * (frame["k1"] + r2 * (frame["k2"] + r2 * frame["k3"]))
        p1, p2 = frame["p1"], frame["p2"]
        u = frame["fl_x"] * (x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)) + frame["cx"]
        v = frame["fl_y"] * (y * radial + 2 * p2 * x * y + p1 * (r2 + 2 * y * y)) + frame["cy"]
        np.testing.assert_allclose(np.stack([u, v], 1), view.camera.project(points, None), atol=1e-6)


@pytest.mark.parametrize("option", ["colmap", "nerfstudio"])
def test_our_own_reader_finds_the_cameras_again(run, tmp_path, option):
    path, views, _ = run(LENSES["brown"])
    target = tmp_path / ("model" if option == "colmap" else "transforms.json")
    export(path, **{option: target})
    found = {pose.name.rpartition("/")[2]: pose for pose in read_poses(target).poses}
    assert set(found) == {view.name for view in views}
    for view in views:
        pose = found[view.name]
        np.testing.assert_allclose(pose.centre, view.camera.centre, atol=1e-9)
        np.testing.assert_allclose(pose.cam_from_world, view.camera.cam_from_local, atol=1e-9)
        pixels = np.array([[5.0, 7.0], [60.0, 44.0]])
        camera = pose.lens.camera(pose.centre, pose.cam_from_world)
        np.testing.assert_allclose(camera.directions(pixels), view.camera.directions(pixels), atol=1e-9)


@pytest.mark.parametrize("option", ["colmap", "nerfstudio"])
def test_the_files_say_where_the_water_is_and_that_rays_bend(run, tmp_path, option):
    path, _, _ = run(LENSES["pinhole"])
    target = tmp_path / ("model" if option == "colmap" else "t.json")
    export(path, **{option: target})
    text = (target / "cameras.txt" if option == "colmap" else target).read_text(encoding="utf-8")
    assert '"refractive_index": 1.333' in text or "# refractive_index: 1.333" in text
    assert "bent there by Snell's law" in text
    assert "EPSG:25832+5778" in text


@pytest.mark.parametrize(
    ("option", "kind"), [("colmap", "skewed"), ("nerfstudio", "skewed"), ("nerfstudio", "rational")]
)
def test_a_lens_that_the_format_does_not_have_is_refused(run, tmp_path, option, kind):
    path, _, _ = run(BESIDE[kind])
    target = tmp_path / ("model" if option == "colmap" else "t.json")
    with pytest.raises(SurveyError, match="undistort the photographs"):
        export(path, **{option: target})
    assert not target.exists()


def test_a_folder_with_other_files_is_not_written_into_and_an_earlier_model_is_replaced(run, tmp_path):
    path, _, _ = run(LENSES["pinhole"])
    other = tmp_path / "other"
    other.mkdir()
    (other / "cameras.txt").write_text("# Camera list with one line of data per camera:\n")
    with pytest.raises(OutputError, match=r"--colmap names .*other, which holds other files; name a new or empty"):
        export(path, colmap=other)
    for _ in range(2):
        export(path, colmap=tmp_path / "model")
    assert sorted(p.name for p in (tmp_path / "model").iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
    with pytest.raises(OutputError, match="whose files are read"):
        export(path, colmap=path / "stages")


def test_names_that_a_colmap_text_would_cut_are_whole_in_a_binary_model(run, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    path, views, _ = run(LENSES["pinhole"])
    target, stored = tmp_path / "model", (path / FLIGHT).read_text("utf-8")
    said = json.loads(stored)
    said["views"][0]["name"] = "DJI 0001.jpg"
    (path / FLIGHT).write_text(json.dumps(said), "utf-8")
    export(path, colmap=target)
    text, model = tmp_path / "text", pycolmap.Reconstruction(target)
    assert {image.name for image in model.images.values()} == {"DJI 0001.jpg", *(view.name for view in views[1:])}
    # All else is what the text says.
    text.mkdir()
    for name in ("cameras.txt", "images.txt", "points3D.txt"):
        (text / name).write_bytes((target / name).read_bytes())
    for number, image in pycolmap.Reconstruction(text).images.items():
        other = model.images[number]
        assert np.array_equal(image.cam_from_world().matrix(), other.cam_from_world().matrix())
        assert np.array_equal(image.camera.params, other.camera.params)
    assert len(model.points3D) == len(pycolmap.Reconstruction(text).points3D) > 0
    # Binary files go before text: those of an earlier export do not stay.
    (path / FLIGHT).write_text(stored, "utf-8")
    export(path, colmap=target)
    assert sorted(p.name for p in target.iterdir()) == ["cameras.txt", "images.txt", "points3D.txt"]
