"""COLMAP models with rigs, frames and every lens, against pycolmap."""

import shutil
import struct
import tracemalloc

import numpy as np
import pycolmap
import pytest

from refract.lens import Lens
from survey.errors import PosesError
from survey.pose_files import read_poses, read_ties
from survey.pose_files.colmap import lens_of

# Roundings of pixels of some hundred.
ROUNDING_PX = 1e-9


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """A model of two rigs of two cameras each, with features that are no points, as text and binary."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D, options.camera_model_id = 40, pycolmap.CameraModelId.OPENCV
    options.camera_params = [1280.0, 1281.0, 512.0, 384.0, -0.05, 0.01, 0.001, -0.002]
    pycolmap.set_random_seed(0)
    model = pycolmap.synthesize_dataset(options)
    folder = tmp_path_factory.mktemp("rigs")
    for kind in ("text", "binary"):
        (folder / kind).mkdir()
    model.write_text(folder / "text")
    model.write_binary(folder / "binary")
    return folder, model


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_rigs_and_frames_give_the_poses_and_ties_of_pycolmap(rigs, kind):
    folder, model = rigs
    file, ties = read_poses(folder / kind), read_ties(folder / kind)
    by_name = {image.name: image for image in model.images.values()}
    assert len(file.poses) == len(by_name) == 12
    for pose in file.poses:
        theirs = by_name[pose.name]
        assert pose.centre == pytest.approx(theirs.projection_center(), abs=1e-12)
        assert pose.cam_from_world == pytest.approx(theirs.cam_from_world().rotation.matrix(), abs=1e-12)
    assert len(ties.points) == 40
    assert len(ties.point) == sum(len(point.track.elements) for point in model.points3D.values())
    poses = {pose.name: pose for pose in file.poses}
    missed = [
        pose.lens.camera(pose.centre, pose.cam_from_world).project(ties.points[p], None) - pixel
        for p, i, pixel in zip(ties.point, ties.image, ties.pixel, strict=True)
        for pose in [poses[ties.names[i]]]
    ]
    # The features of the model are exact, so half a pixel or swapped coefficients could not hide.
    assert np.abs(missed).max() < 1e-6


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("names", [("rigs", "frames"), ("points3D",), ("rigs", "frames", "points3D")])
def test_a_model_of_version_3_or_without_points_has_the_same_poses(rigs, tmp_path, kind, names):
    folder, _ = rigs
    shutil.copytree(folder / kind, tmp_path / "m")
    for name in names:
        next((tmp_path / "m").glob(f"{name}.*")).unlink()
    for pose, whole in zip(read_poses(tmp_path / "m").poses, read_poses(folder / kind).poses, strict=True):
        assert (pose.centre == whole.centre).all()
        assert (pose.cam_from_world == whole.cam_from_world).all()


@pytest.mark.parametrize("count", [1300, 10**6, 2**40, 2**64 - 1])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_counts_that_the_file_cannot_hold_are_refused_in_little_memory(rigs, tmp_path, name, count):
    shutil.copytree(rigs[0] / "binary", tmp_path / "m")
    path = tmp_path / "m" / f"{name}.bin"
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    tracemalloc.start()
    with pytest.raises(PosesError, match=f"{name}.bin is damaged or not a COLMAP file|{name}.bin: camera model number"):
        read_poses(tmp_path / "m"), read_ties(tmp_path / "m")
    # The files have less than 0.1 MB, and Python's objects are some ten times as large.
    assert tracemalloc.get_traced_memory()[1] < 20e6
    tracemalloc.stop()


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL_FISHEYE", (500.0, 321.0, 239.0, 0.03)),
        ("RADIAL_FISHEYE", (500.0, 321.0, 239.0, 0.03, -0.02)),
        ("SIMPLE_FISHEYE", (500.0, 321.0, 239.0)),
        ("FISHEYE", (500.0, 505.0, 321.0, 239.0)),
        ("OPENCV_FISHEYE", (500.0, 505.0, 321.0, 239.0, 0.03, -0.02, 0.01, -0.004)),
        ("FULL_OPENCV", (500.0, 505.0, 321.0, 239.0, 0.1, -0.05, 0.002, -0.003, 0.02, 0.12, -0.04, 0.01)),
        ("OPENCV", (500.0, 505.0, 321.0, 239.0, 0.1, -0.05, 0.002, -0.003)),
        ("RADIAL", (500.0, 321.0, 239.0, 0.1, -0.05)),
    ],
)
def test_lenses_project_as_those_of_pycolmap(model, params, rng):
    theirs = pycolmap.Camera(model=model, width=640, height=480, params=list(params))
    points = np.column_stack([rng.uniform(-0.6, 0.6, (50, 2)), np.ones(50)])
    expected = theirs.img_from_cam(points)
    ours = lens_of(model, params, 640, 480)
    assert isinstance(ours, Lens)
    found = ours.camera(np.zeros(3), np.eye(3)).project(points, None)
    assert np.abs(found - expected).max() < ROUNDING_PX
