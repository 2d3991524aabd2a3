"""Any key of a foreign file that changes the lens is read or refused, in every format that has a lens."""

import json
from xml.etree.ElementTree import fromstring

import pytest

from refract.lens import LensError
from survey.errors import PosesError
from survey.pose_files import opensfm, read_poses
from survey.pose_files.format import is_lens_key, require_understood
from survey.pose_files.metashape import read_lens

NOTHING = [0, 0.0, False, None, "", "0", "0 0.0 0", "False", [], {}, [0.0, 0.0], [[0], 0.0], {"x": 0.0}]
SOMETHING = [1, -1e-9, True, "0.1", "0 0 1", "fisheye", [0.0, 0.1], {"x": 2}]
OF_LENS = [
    "k5", "K6", "k_3", "p3", "p4", "b1", "b2", "s1", "s4", "tau1", "sx1", "skew", "lens_skew", "shear", "fx", "f_y",
    "cx", "c_y", "fl_z", "x_fov", "fov", "is_fisheye", "fisheye624_params", "is_latlong", "lat_long", "equirectangular",
    "panorama", "ftheta_p1", "distortion_params", "distortion_model", "dist_coeffs", "lens_mode", "rolling_shutter",
    "principal_point", "camera_intrinsics", "projection_type", "focal_length", "thin_prism", "affinity", "aspect_ratio",
]  # fmt: skip
NOT_OF_LENS = [
    "file_path", "transform_matrix", "mask_path", "depth_file_path", "sharpness", "colmap_im_id", "aabb_scale", "scale",
    "offset", "applied_transform", "orientation_override", "ply_file_path", "frames", "timestamp", "iso", "exposure",
    "camera_id", "lens_make", "lens_model", "lens_serial_number", "r11", "std_x", "name", "time", "gps", "camera",
]  # fmt: skip


@pytest.mark.parametrize("value", SOMETHING, ids=repr)
def test_what_is_said_of_a_lens_is_read_or_refused(value):
    for key in OF_LENS:
        with pytest.raises(LensError, match=f"{key} is .*, a part of the lens that is not read, .*; undistort"):
            require_understood({key: value}, ("w", "h"), remedy="undistort")
        require_understood({key: value}, (key,), remedy="undistort")


@pytest.mark.parametrize("value", NOTHING, ids=repr)
def test_what_is_zero_or_off_changes_nothing(value):
    require_understood(dict.fromkeys(OF_LENS, value), (), remedy="undistort", are_all_of_lens=True)


def test_other_keys_are_not_taken_for_those_of_a_lens():
    assert [key for key in NOT_OF_LENS if is_lens_key(key)] == []
    require_understood(dict.fromkeys(NOT_OF_LENS, 1), (), remedy="undistort")


@pytest.mark.parametrize("place", ["root", "frame"])
def test_nerfstudio(tmp_path, place):
    frame = {"file_path": "a.jpg", "transform_matrix": [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
    data = {"w": 64, "h": 48, "fl_x": 100.0, "cx": 32.0, "cy": 24.0, "aabb_scale": 16}
    for key in OF_LENS:
        if key in ("is_fisheye", "x_fov", "cx"):
            continue
        for value in (0, 0.1):
            more = {key: value}
            whole = data | {"frames": [frame | (more if place == "frame" else {})]} | (more if place == "root" else {})
            (tmp_path / "transforms.json").write_text(json.dumps(whole))
            if value == 0:
                assert read_poses(tmp_path / "transforms.json").poses[0].lens.width == 64
                continue
            with pytest.raises(PosesError, match=f"frame a.jpg: {key} is 0.1, a part of the lens that is not read"):
                read_poses(tmp_path / "transforms.json")


CAMERA = {"projection_type": "brown", "width": 64, "height": 48, "focal_x": 1.5, "focal_y": 1.5, "c_x": 0.0, "c_y": 0.0}


@pytest.mark.parametrize(
    ("kind", "key"),
    [("brown", "k4"), ("brown", "k6"), ("brown", "s0"), ("perspective", "skew"), ("fisheye", "p1"), ("radial", "new"),
     ("fisheye_opencv", "k5"), ("simple_radial", "transition"), ("fisheye", "rolling_shutter")],
)  # fmt: skip
def test_opensfm(kind, key):
    camera = CAMERA | {"projection_type": kind}
    assert opensfm.read_lens(camera | {key: 0.0, f"{key}_prior": 0.1, "k1_prior": 0.1, "focal_prior": 1.4}).width == 64
    with pytest.raises(LensError, match=f"{key} is 0.1, a part of the lens that is not read"):
        opensfm.read_lens(camera | {key: 0.1})


SENSOR = """<sensor id="0" label="one" type="{kind}"><resolution width="64" height="48"/>
<property name="pixel_width" value="0.002"/><calibration type="{kind}" class="adjusted"><resolution width="64"
height="48"/><f>100</f><date>2026-05-01T10:00:00Z</date>{more}</calibration><covariance/></sensor>"""


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
@pytest.mark.parametrize("key", ["p3", "p4", "k5", "fx", "fy", "skew", "tau1", "anything"])
def test_metashape(kind, key):
    assert read_lens(fromstring(SENSOR.format(kind=kind, more=f"<{key}>0.0</{key}>"))).width == 64
    with pytest.raises(LensError, match=f"{key} is 0.1, a part of the lens that is not read"):
        read_lens(fromstring(SENSOR.format(kind=kind, more=f"<{key}>0.1</{key}>")))


def test_columns_of_a_lens_in_a_table_of_poses_are_named(tmp_path):
    (tmp_path / "a.csv").write_text("image,x,y,z,omega,phi,kappa,fx,k1,r11\na.jpg,1,2,3,0,0,0,100,0.1,1\n")
    (warning,) = read_poses(tmp_path / "a.csv").warnings
    assert warning == "columns of a lens in a.csv (fx, k1) are not read: give it in [cameras]"


PIX4D = """fileName imageWidth imageHeight
camera matrix K [3x3]
radial distortion [3x1]
{more}
camera model m = K [R|-Rt] X
"""


@pytest.mark.parametrize("more", ["fisheye distortion [4x1]", "affine matrix [2x2]", "polynomial coefficients [4x1]"])
def test_pix4d(tmp_path, more):
    path = tmp_path / "p_calibrated_camera_parameters.txt"
    path.write_text(PIX4D.format(more=more))
    with pytest.raises(PosesError, match=r"line 4: .* is of another lens, expected a perspective one"):
        read_poses(path)
