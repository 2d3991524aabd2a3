"""Poses files: cameras.csv and COLMAP, against hand computation, pycolmap and each other."""

import math
import shutil
import struct

import numpy as np
import pycolmap
import pytest
from small_survey import HEADER

from refract.lens import MODELS, Lens, LensError
from survey.errors import PosesError
from survey.folder.survey import load_survey
from survey.photos.poses import grid_from_opk
from survey.pose_files import colmap, find_poses, find_unread, pose_files, read_poses, read_ties, tables

# cameras.csv of the drawn surveys is written to 1e-5 m and 1e-8 degrees, the COLMAP model to 1e-12.
CENTRE_TOLERANCE_M = 1e-3
ROTATION_TOLERANCE = 1e-6

LENS = "1 PINHOLE 64 48 100 101 32 24\n"


def project(pose, point, *, focal=100.0, centre=(32.0, 24.0)):
    """Pixel of a point relative to the camera, in the axes of the pose, written out component by component."""
    x, y, z = pose.cam_from_world @ np.asarray(point, dtype=float)
    return focal * x / z + centre[0], focal * y / z + centre[1]


def read_one(tmp_path, omega, phi, kappa):
    path = tmp_path / "cameras.csv"
    path.write_text(f"{HEADER}\na.jpg,10.0,46.0,100.0,{omega},{phi},{kappa}\n")
    (pose,) = tables.read_table(path).poses
    return pose


def test_two_points_appear_where_omega_phi_kappa_put_them_by_hand(tmp_path):
    # A level camera: 10 m below it, 1 m east is 10 px to the right and 2 m north 20 px up.
    level = read_one(tmp_path, 0, 0, 0)
    assert project(level, (1.0, 0.0, -10.0)) == pytest.approx((42.0, 24.0))
    assert project(level, (0.0, 2.0, -10.0)) == pytest.approx((32.0, 4.0))
    # Turned by kappa = 90 degrees, its right side is to the north and its upper side to the west.
    turned = read_one(tmp_path, 0, 0, 90)
    assert project(turned, (1.0, 0.0, -10.0)) == pytest.approx((32.0, 34.0))
    assert project(turned, (0.0, 2.0, -10.0)) == pytest.approx((52.0, 24.0))


def test_omega_tips_the_view_north_and_phi_tips_it_west(tmp_path):
    down = 10.0
    north = down * math.tan(math.radians(10.0))
    assert project(read_one(tmp_path, 10, 0, 0), (0.0, north, -down)) == pytest.approx((32.0, 24.0))
    west = down * math.tan(math.radians(20.0))
    assert project(read_one(tmp_path, 0, 20, 0), (-west, 0.0, -down)) == pytest.approx((32.0, 24.0))


def test_the_rotation_gives_back_its_angles_by_the_published_formulas(rng):
    # Extraction from the camera-to-world matrix as in orthority and OpenDroneMap.
    for omega, phi, kappa in rng.uniform(-1.4, 1.4, (20, 3)):
        r = grid_from_opk(omega, phi, kappa)
        assert r @ r.T == pytest.approx(np.eye(3), abs=1e-15)
        assert math.atan2(-r[1, 2], r[2, 2]) == pytest.approx(omega, abs=1e-14)
        assert math.asin(r[0, 2]) == pytest.approx(phi, abs=1e-14)
        assert math.atan2(-r[0, 1], r[0, 0]) == pytest.approx(kappa, abs=1e-14)


@pytest.mark.parametrize("name", ["quick", "river"])
def test_cameras_csv_and_colmap_text_and_binary_give_the_same_cameras(data_dir, tmp_path, name):
    source = data_dir / name
    toml = (source / "survey.toml").read_text()
    surveys = []
    for poses in ("cameras.csv", "text", "binary"):
        folder = tmp_path / poses
        folder.mkdir()
        (folder / "images").symlink_to(source / "images")
        shutil.copy(source / "cameras.csv", folder / "cameras.csv")
        shutil.copytree(source / "sparse" / "0", folder / "text")
        (folder / "binary").mkdir()
        pycolmap.Reconstruction(folder / "text").write_binary(folder / "binary")
        (folder / "survey.toml").write_text(toml.replace('poses = "cameras.csv"', f'poses = "{poses}"'))
        surveys.append(load_survey(folder))
    by_csv = surveys[0]
    for survey in surveys[1:]:
        assert [v.name for v in survey.views] == [v.name for v in by_csv.views]
        for ours, theirs in zip(by_csv.views, survey.views, strict=True):
            in_frame = by_csv.frame.local_from_crs(survey.frame.crs_from_local(theirs.camera.centre))
            assert np.linalg.norm(in_frame - ours.camera.centre) < CENTRE_TOLERANCE_M
            turn = ours.camera.cam_from_local @ theirs.camera.cam_from_local.T
            assert np.abs(turn - np.eye(3)).max() < ROTATION_TOLERANCE
            assert ours.camera.fx == theirs.camera.fx


def test_the_ids_of_our_models_are_those_of_colmap():
    for model, (number, names) in MODELS.items():
        if number is None:
            continue  # none of COLMAP's
        camera = pycolmap.Camera(model=model, width=10, height=10, params=[1.0] * len(names))
        assert int(camera.model) == number
        spelt = ["k1" if name.strip() == "k" else name.strip() for name in camera.params_info.split(",")]
        assert spelt == list(names)


def write_model(folder, images: str, cameras: str = LENS):
    folder.mkdir(exist_ok=True)
    (folder / "cameras.txt").write_text(cameras)
    (folder / "images.txt").write_text(images)
    return folder


@pytest.mark.parametrize("model", ["FOV", "THIN_PRISM_FISHEYE", "EQUIRECTANGULAR"])
def test_a_camera_model_that_cannot_be_undistorted_is_refused_by_name(tmp_path, model):
    folder = write_model(tmp_path / "m", "1 1 0 0 0 0 0 0 1 a.jpg\n\n", f"1 {model} 64 48 1 2 3 4\n")
    with pytest.raises(PosesError, match=rf"cameras\.txt: camera model {model} is not supported, expected one of"):
        colmap.read_model(folder)


@pytest.mark.parametrize(("model", "num"), [(7, 5), (10, 12), (11, 16), (12, 4), (13, 5), (16, 6), (17, 2)])
def test_a_binary_model_is_refused_for_its_lens_only_where_an_image_uses_it(tmp_path, model, num):
    other = struct.pack(f"<IiQQ{num}d", 1, model, 64, 48, *range(1, num + 1))
    pinhole = struct.pack("<IiQQ4d", 2, 1, 64, 48, 50.0, 50.0, 32.0, 24.0)
    (tmp_path / "cameras.bin").write_bytes(struct.pack("<Q", 2) + other + pinhole)
    image = struct.pack("<QI7dI", 1, 1, 1, 0, 0, 0, 0, 0, 0, 2) + b"a.jpg\0" + struct.pack("<Q", 0)
    (tmp_path / "images.bin").write_bytes(image)
    assert colmap.read_model(tmp_path).poses[0].lens.model == "PINHOLE"
    (tmp_path / "images.bin").write_bytes(image[:68] + struct.pack("<I", 1) + image[72:])
    with pytest.raises(PosesError, match=r"cameras\.bin: camera model [A-Z_0-9]* is not supported"):
        colmap.read_model(tmp_path)


@pytest.mark.parametrize(
    ("images", "words"),
    [
        ("1 1 0 0 0 nan 0 0 1 a.jpg\n\n", "the pose of a.jpg is [1.0, 0.0, 0.0, 0.0, nan, 0.0, 0.0]"),
        ("1 0 0 0 0 1 0 0 1 a.jpg\n\n", "expected a quaternion"),
        ("1 1 0 0 0 0 0 0 9 a.jpg\n\n", "image a.jpg has camera 9, not in cameras.txt"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n\n2 1 0 0 0 0 0 0 1 a.jpg\n\n", "image a.jpg has a second pose"),
        ("1 1 0 0 0 0 0 0 1 a.jpg\n2 1 0 0 0 0 0 0 1 b.jpg\n", "the line after image a.jpg is not a list of points"),
        ("1 1 0 0 0 zero 0 0 1 a.jpg\n\n", "images.txt is damaged or not a COLMAP file"),
        ("1 1 0 0\n\n", "images.txt is damaged or not a COLMAP file"),
    ],
)
def test_a_spoilt_model_is_refused_with_the_file_and_the_image(tmp_path, images, words):
    with pytest.raises(PosesError) as error:
        read_poses(write_model(tmp_path / "m", images))
    assert words in str(error.value)


@pytest.mark.parametrize("name", ["images", "points3D"])
def test_a_binary_model_that_is_cut_off_is_refused_wherever_the_cut_is(tmp_path, name):
    text = write_model(tmp_path / "text", "1 1 0 0 0 0 0 0 1 a.jpg\n1 2 1 3 4 -1\n2 1 0 0 0 1 1 1 1 b.jpg\n1 2 1\n")
    (text / "points3D.txt").write_text("# a comment\n1 0.5 1.5 2.5 9 9 9 0.5 1 0 2 0\n")
    whole = tmp_path / "whole"
    whole.mkdir()
    pycolmap.Reconstruction(text).write_binary(whole)
    for folder in (text, whole):
        ties = read_ties(folder)
        assert (ties.points.tolist(), ties.num_views.tolist()) == ([[0.5, 1.5, 2.5]], [2])
        assert (ties.image.tolist(), ties.pixel.tolist()) == ([0, 1], [[1.0, 2.0], [1.0, 2.0]])
    data = (whole / f"{name}.bin").read_bytes()
    assert len(colmap.read_model(whole).poses) == 2
    for length in range(len(data)):
        (whole / f"{name}.bin").write_bytes(data[:length])
        with pytest.raises(PosesError, match=rf"{name}\.bin is damaged"):
            colmap.read_model(whole), read_ties(whole)
    (text / "points3D.txt").write_text("1 0 0 0 9 9 9 0.5 1\n")
    with pytest.raises(PosesError, match=r"points3D\.txt is damaged"):
        read_ties(text)
    (text / "points3D.txt").unlink()
    assert read_ties(text) is None


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ("", "the first line has no column image, easting"),
        ("image,easting,northing,height,omega,phi\n", "the first line has no column kappa; expected image,easting"),
        (f"{HEADER}\na.jpg,1,2,nan,0,0,0\n", "line 2: height is nan, expected a finite number"),
        (f"{HEADER}\na.jpg,1,2,3,0,,0\n", "line 2: phi is empty, expected a finite number"),
        (f"{HEADER}\na.jpg,1,2,3,0,0,0\n\nb.jpg,1,2,3,0,0,1e999\n", "line 4: kappa is 1e999"),
        (f"{HEADER}\na.jpg,1,2,3\n", "line 2: 4 values were found, expected 7"),
        (f"{HEADER}\na.jpg,1,2,3,0,0,0\na.jpg,1,2,3,0,0,0\n", "line 3: image a.jpg has a second pose"),
        (f"{HEADER}\n,1,2,3,0,0,0\n", "line 2: image is empty, expected a text"),
    ],
)
def test_a_spoilt_table_is_refused_with_the_line_and_the_column(tmp_path, table, words):
    path = tmp_path / "cameras.csv"
    path.write_text(table)
    with pytest.raises(PosesError) as error:
        read_poses(path)
    assert words in str(error.value)
    assert str(path) in str(error.value)


def test_poses_are_found_beside_the_images_and_other_formats_are_named(tmp_path):
    write_model(tmp_path / "sparse", "")
    (tmp_path / "gcp.csv").write_text("label,x,y,z\n")
    assert find_poses(tmp_path) == [tmp_path / "sparse"]
    (tmp_path / "poses.csv").write_text(HEADER)
    assert find_poses(tmp_path) == [tmp_path / "poses.csv", tmp_path / "sparse"]
    (tmp_path / "flight.nvm").write_text("NVM_V3")
    assert find_unread(tmp_path) == ["flight.nvm is not read: export a COLMAP model instead"]
    with pytest.raises(PosesError, match="is not read: export a COLMAP model instead; expected one of"):
        read_poses(tmp_path / "flight.nvm")


@pytest.mark.parametrize(
    ("params", "size", "words"),
    [
        ((100.0, 32.0), (64, 48), "has 2 numbers, expected 4: fx, fy, cx, cy"),
        ((100.0, math.nan, 32.0, 24.0), (64, 48), "expected finite ones"),
        ((-100.0, 100.0, 32.0, 24.0), (64, 48), "a focal length above zero"),
        ((100.0, 100.0, 32.0, 24.0), (0, 48), "has 0 x 48 pixels"),
    ],
)
def test_a_lens_of_impossible_numbers_is_refused(params, size, words):
    with pytest.raises(LensError) as error:
        Lens("PINHOLE", params, *size)
    assert words in str(error.value)


def test_all_files_that_are_read_for_poses_are_inputs_that_no_result_replaces(tmp_path):
    model = write_model(tmp_path / "m", "1 1 0 0 0 0 0 0 1 a.jpg\n\n")
    assert [pose.name for pose in read_poses(model / "images.txt").poses] == ["a.jpg"]
    (model / "points3D.txt").write_text("")
    assert {path.name for path in pose_files(model / "images.txt")} == {"images.txt", "cameras.txt", "points3D.txt"}
    assert set(pose_files(model)) == set(pose_files(model / "images.txt"))
    for name in ("reconstruction.json", "tracks.csv", "reference_lla.json", "other.json"):
        (tmp_path / name).write_text("[]")
    names = {path.name for path in pose_files(tmp_path / "reconstruction.json")}
    assert names == {"reconstruction.json", "tracks.csv", "reference_lla.json"}
    stem = "p_calibrated_external_camera_parameters.txt"
    for name in (stem, "p_offset.xyz", "q_offset.xyz"):
        (tmp_path / name).write_text("")
    assert {path.name for path in pose_files(tmp_path / stem)} == {stem, "p_offset.xyz"}
    assert pose_files(tmp_path / "none.csv") == [tmp_path / "none.csv"]
