"""nerfstudio's transforms.json: what its converter applied, lenses of all and of each frame, masks."""

import json

import numpy as np
import pytest
from foreign_block import CLOSE_PX, SIZE, draw_block, in_utm, load, most_missed_px
from PIL import Image

from survey.errors import PosesError
from survey.pose_files import find_poses, read_poses

# The converters of nerfstudio for COLMAP's models and for Metashape's cameras.
COLMAPS = [[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0]]
METASHAPES = [[0, 0, 1, 0.5], [1, 0, 0, -2.0], [0, 1, 0, 3.0]]


@pytest.fixture(scope="module")
def block():
    return draw_block()


def inner(lens) -> dict:
    k = {f"k{i + 1}": value for i, value in enumerate(lens.k)}
    sizes = {"w": SIZE[0], "h": SIZE[1]}
    return {"fl_x": lens.fx, "fl_y": lens.fy, "cx": lens.cx, "cy": lens.cy, **sizes, **k, "p1": lens.p1, "p2": lens.p2}


def transforms(block, *, applied=COLMAPS, scale=1.0, per_frame=False, **more) -> dict:
    frames = []
    change = np.eye(4)
    change[:3] = np.array(applied if applied is not None else np.eye(4)[:3])
    for i, name in enumerate(block.names):
        original = np.eye(4)
        # x right, y up, z back.
        original[:3, :3] = block.cams[i].T @ np.diag([1.0, -1.0, -1.0])
        original[:3, 3] = block.centres[i]
        saved = change @ original
        saved[:3, 3] *= scale
        frames.append({"file_path": f"./images/{name}", "transform_matrix": saved.tolist()})
        if per_frame:
            frames[-1] |= inner(block.lens)
    found = {"camera_model": "OPENCV", "frames": frames, **more}
    found |= {} if per_frame else inner(block.lens)
    found |= {} if applied is None else {"applied_transform": applied}
    return found | ({} if scale == 1.0 else {"applied_scale": scale})


def loaded(folder, block, data):
    folder.mkdir(exist_ok=True)
    (folder / "transforms.json").write_text(json.dumps(data))
    origin = in_utm(np.zeros((1, 3)))[0].tolist()
    return load(folder, block, "transforms.json", f"[local]\norigin = {origin}")


@pytest.mark.parametrize(
    "how",
    [
        {"applied": COLMAPS}, {"applied": METASHAPES}, {"applied": METASHAPES, "scale": 0.37}, {"applied": None},
        {"applied": COLMAPS, "per_frame": True},
    ],
    ids=["COLMAP's", "Metashape's", "scaled", "none", "per frame"],
)  # fmt: skip
def test_what_was_applied_is_undone(tmp_path, block, how):
    survey = loaded(tmp_path, block, transforms(block, **how))
    assert find_poses(tmp_path) == [tmp_path / "transforms.json"]
    assert most_missed_px(survey, block) < CLOSE_PX
    assert any("no applied_transform" in text for text in survey.findings.assumptions) == (how["applied"] is None)


def test_the_eighth_power_of_the_radius_is_kept(tmp_path, block):
    block = block.with_lens(k=(-0.08, 0.03, -0.01, 0.02))
    survey = loaded(tmp_path, block, transforms(block))
    assert survey.views[0].lens.model == "BROWN_AFFINE"
    assert most_missed_px(survey, block) < CLOSE_PX


def test_a_field_of_view_gives_the_focal_length(tmp_path, block):
    data = transforms(block, camera_angle_x=2.0 * np.arctan(0.5 * SIZE[0] / 520.0))
    del data["fl_x"], data["fl_y"]
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    (pose, *_) = read_poses(tmp_path / "transforms.json").poses
    assert pose.lens.focal == pytest.approx((520.0, 520.0))


def test_an_angle_alone_takes_the_size_of_the_photograph(tmp_path, block):
    """Blender's and instant-ngp's form, whose names may have no suffix."""
    frame = transforms(block)["frames"][0] | {"file_path": "./train/r_0"}
    (tmp_path / "transforms.json").write_text(
        json.dumps({"camera_angle_x": 2.0 * np.arctan(0.5 * 64 / 52.0), "frames": [frame]})
    )
    with pytest.raises(PosesError, match="w and h are missing, and no photograph of that name"):
        read_poses(tmp_path / "transforms.json")
    (tmp_path / "train").mkdir()
    Image.new("RGB", (64, 48)).save(tmp_path / "train/r_0.png")
    (pose,) = read_poses(tmp_path / "transforms.json").poses
    assert (pose.lens.width, pose.lens.height) == (64, 48)
    assert pose.lens.focal == pytest.approx((52.0, 52.0))


def test_masks_are_found_below_the_file_and_nowhere_else(tmp_path, block):
    (tmp_path / "masks").mkdir()
    Image.fromarray(np.full(SIZE[::-1], 255, dtype=np.uint8)).save(tmp_path / "masks" / "0000.png")
    for mask, expected in (("masks/0000.png", tmp_path / "masks"), ("../../etc/0000.png", None), ("\0", None)):
        data = transforms(block)
        data["frames"][0]["mask_path"] = mask
        (tmp_path / "transforms.json").write_text(json.dumps(data))
        assert read_poses(tmp_path / "transforms.json").masks == expected


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"frames": 1}, "has no list of frames"),
        ({"frames": []}, "has no poses"),
        ({"frames": [{}]}, "a frame has no file_path"),
        ({"frames": [{"file_path": "a"}]}, "its transform_matrix is not a 4 x 4 matrix"),
        ({"frames": [{"file_path": "a", "transform_matrix": np.diag([2.0, 1, 1, 1]).tolist()}]}, "is not a rotation"),
        ({"frames": [{"file_path": "a", "transform_matrix": np.diag([-1.0, 1, 1, 1]).tolist()}]}, "is not a rotation"),
        ({"applied_transform": np.diag([1.0, 1, -1, 1])[:3].tolist()}, "applied_transform is not a 3 x 4 matrix"),
        ({"applied_scale": 0}, "applied_scale is 0.0, expected a number above 0"),
        ({"fl_x": float("nan")}, "fl_x is nan, expected a finite number"),
        ({"w": 10**400}, "w is inf, expected a finite"),
        ({"w": "640"}, "w is 640, expected a finite number"),
        ({"camera_model": "EQUIRECTANGULAR"}, "camera model EQUIRECTANGULAR is not supported"),
    ],
)
def test_a_fault_is_refused_in_one_sentence(tmp_path, block, change, words):
    (tmp_path / "transforms.json").write_text(json.dumps({**transforms(block), **change}))
    with pytest.raises(PosesError, match=words):
        read_poses(tmp_path / "transforms.json")


@pytest.mark.parametrize("word", [True, 1])
def test_the_flag_of_instant_ngp_makes_it_a_fisheye(tmp_path, block, word):
    data = transforms(block)
    del data["camera_model"]
    (tmp_path / "transforms.json").write_text(json.dumps(data | {"is_fisheye": word, "p1": 0.0, "p2": 0.0}))
    lens = read_poses(tmp_path / "transforms.json").poses[0].lens
    assert lens.model == "OPENCV_FISHEYE"
    assert lens["k1"] == block.lens.k[0]


def test_two_words_for_the_lens_that_contradict_each_other_are_refused(tmp_path, block):
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(block) | {"is_fisheye": True}))
    with pytest.raises(PosesError, match="is_fisheye is true, and camera_model is OPENCV"):
        read_poses(tmp_path / "transforms.json")


def test_terms_that_are_zero_and_flags_that_are_off_change_nothing(tmp_path, block):
    more = {"is_fisheye": False, "k5": 0.0, "p3": 0, "is_latlong": False}
    (tmp_path / "transforms.json").write_text(json.dumps(transforms(block) | more))
    assert read_poses(tmp_path / "transforms.json").poses[0].lens.model == "FULL_OPENCV"


def test_the_focal_length_of_a_frame_goes_before_that_of_the_root(tmp_path, block):
    data = transforms(block)
    angle = 2.0 * np.arctan(0.5 * SIZE[0] / 1234.0)
    data["frames"][0]["camera_angle_x"] = angle
    (tmp_path / "transforms.json").write_text(json.dumps(data))
    poses = read_poses(tmp_path / "transforms.json").poses
    assert poses[0].lens.focal[0] == pytest.approx(1234.0)
    assert poses[1].lens.focal[0] == pytest.approx(block.lens.fx)


def camera_path(folder, block, **changes):
    """A path along the block's cameras, as nerfstudio's viewer writes it in the frame of a training."""
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    given, views = np.column_stack([turn, [0.5, -2.0, 0.3]]), []
    for cam, centre in zip(block.cams, block.centres, strict=True):
        matrix = np.eye(4)
        matrix[:3, :3] = turn @ cam.T @ np.diag([1.0, -1.0, -1.0])
        matrix[:3, 3] = 0.07 * (turn @ centre + given[:, 3])
        views.append({"camera_to_world": matrix.ravel().tolist(), "fov": 50.0, "aspect": 1.5})
    data = {"keyframes": [], "camera_type": "perspective", "render_height": 400, "render_width": 600, "fps": 24}
    (folder / "flight.json").write_text(json.dumps(data | {"camera_path": views} | changes))
    beside = folder / "dataparser_transforms.json"
    beside.write_text(json.dumps({"transform": given.tolist(), "scale": 0.07}))
    return folder / "flight.json"


def test_a_camera_path_is_in_the_frame_before_the_training(tmp_path, block):
    file = read_poses(camera_path(tmp_path, block))
    assert file.is_camera_path
    np.testing.assert_allclose([pose.centre for pose in file.poses], block.centres, atol=1e-9)
    np.testing.assert_allclose([pose.cam_from_world for pose in file.poses], block.cams, atol=1e-9)
    lens = file.poses[0].lens
    assert (lens.width, lens.height) == (600, 400)
    assert lens.focal == pytest.approx(2 * [200.0 / np.tan(np.radians(25.0))])


@pytest.mark.parametrize(
    ("changes", "beside", "words"),
    [
        ({}, None, "copy dataparser_transforms.json of that training"),
        ({}, {"scale": 1.0}, "dataparser_transforms.json has a transform of None and a scale of 1.0, expected a 3 x 4"),
        ({}, {"transform": [[1.0, 0.0, 0.0, 0.0]] * 3, "scale": 0}, "a scale of 0, expected"),
        ({"camera_path": [{"camera_to_world": [1.0] * 16}]}, "kept", "has a fov of 0 degrees, expected"),
        ({}, [], "or .* no transform"),
        ({"camera_path": {}}, {}, "has no list of cameras"),
        ({"camera_path": [{"camera_to_world": [1.0] * 15, "fov": 50}]}, "kept", "its transform_matrix is not a 4 x 4"),
        ({"camera_type": "equirectangular"}, "kept", "camera model equirectangular is not supported"),
    ],
)
def test_a_camera_path_with_a_fault_is_refused_in_one_sentence(tmp_path, block, changes, beside, words):
    path = camera_path(tmp_path, block, **changes)
    other = path.with_name("dataparser_transforms.json")
    if beside is None:
        other.unlink()
    elif beside != "kept":
        other.write_text(json.dumps(beside))
    with pytest.raises(PosesError, match=words):
        read_poses(path)
