"""COLMAP models with rigs, frames and every lens, against pycolmap."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from refract.lens import Lens
from survey.errors import PosesError
from survey.pose_files import read_poses, read_ties
from survey.pose_files.colmap_files import lens_of

# Roundings of pixels of some hundred.
ROUNDING_PX = 1e-9


@pytest.fixture(scope="module")
def rigs(tmp_path_factory):
    """A model of two rigs of two cameras each, with features that are no points, as text and binary."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig, options.num_frames_per_rig = 2, 2, 3
    options.num_points3D, options.camera_model_id = 40, pycolmap.CameraModelId.OPENCV
    options.camera_params = [1280.0, 1281.0, 512.0, 384.0, -0.05, 0.01, 0.001, -0.002]
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
def test_images_that_contradict_their_rig_are_refused(rigs, tmp_path, kind):
    folder, _ = rigs
    model = pycolmap.Reconstruction(folder / kind)
    write = {"text": model.write_text, "binary": model.write_binary}[kind]
    write(tmp_path)
    frames = model.frames
    frame = frames[min(frames)]
    moved = pycolmap.Rigid3d(frame.rig_from_world.rotation, frame.rig_from_world.translation + 0.01)
    frame.rig_from_world = moved
    other = tmp_path / "moved"
    other.mkdir()
    {"text": model.write_text, "binary": model.write_binary}[kind](other)
    name = {"text": "frames.txt", "binary": "frames.bin"}[kind]
    (tmp_path / name).write_bytes((other / name).read_bytes())
    with pytest.raises(PosesError, match="is not that of its rig in frames"):
        read_poses(tmp_path)
    (tmp_path / name).unlink()
    assert len(read_poses(tmp_path).poses) == 12


@pytest.mark.parametrize("kind", ["text", "binary"])
@pytest.mark.parametrize("name", ["rigs", "frames"])
def test_rigs_and_frames_that_are_cut_off_are_refused(rigs, tmp_path, kind, name):
    _, model = rigs
    {"text": model.write_text, "binary": model.write_binary}[kind](tmp_path)
    path = tmp_path / f"{name}.{'txt' if kind == 'text' else 'bin'}"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) - 9 if kind == "binary" else data.rindex(b" ", 0, len(data) - 40)])
    with pytest.raises(PosesError, match=f"{name}.* is damaged"):
        read_poses(tmp_path)


@pytest.mark.parametrize(
    ("number", "value", "words"),
    [
        (9, "9" * 400, "frames.* is damaged"),
        (2, "nan", "is not that of its rig in frames"),
        (3, "inf", "is not that of its rig in frames"),
        (6, "1e308", "is not that of its rig in frames"),
    ],
    ids=["photographs without end", "NaN", "infinite", "far away"],
)
def test_numbers_of_a_frame_that_nobody_means_are_refused(rigs, tmp_path, number, value, words):
    rigs[1].write_text(tmp_path)
    lines = (tmp_path / "frames.txt").read_text().splitlines()
    parts = lines[-1].split()
    parts[number] = value
    (tmp_path / "frames.txt").write_text("\n".join([*lines[:-1], " ".join(parts), ""]))
    with pytest.raises(PosesError, match=words):
        read_poses(tmp_path)


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
