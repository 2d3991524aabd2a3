"""Pinhole cameras: half pixels, scaling, and the round trip from pixel to bed and back."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from refract import FlatWater, PinholeCamera
from refract.distortion import BROWN, Distortion

PIXEL = 1e-6  # the promise: project after paths; measured worst 3e-13 px
FLIP = np.diag([1.0, -1.0, -1.0])  # camera x east, y south, z down: a nadir view, north up


def nadir_camera(**changes) -> PinholeCamera:
    numbers = {
        "centre": [3.0, -2.0, 30.0], "cam_from_local": FLIP, "fx": 900.0, "fy": 910.0,
        "cx": 250.0, "cy": 195.0, "width": 512, "height": 384,
    }  # fmt: skip
    return PinholeCamera(**(numbers | changes))


def oblique_camera(tilt_deg: float, heading_deg: float) -> PinholeCamera:
    turn = Rotation.from_euler("zx", [heading_deg, tilt_deg], degrees=True).as_matrix()
    return nadir_camera(cam_from_local=FLIP @ turn.T)


def test_the_first_pixel_centre_is_at_one_half():
    pixels = nadir_camera().pixel_centres()
    assert pixels.shape == (384, 512, 2)
    np.testing.assert_array_equal(pixels[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(pixels[383, 511], [511.5, 383.5])


def test_the_principal_point_looks_along_the_axis_and_axes_point_as_agreed():
    camera = nadir_camera()
    np.testing.assert_allclose(camera.directions([250.0, 195.0]), [0.0, 0.0, -1.0], atol=1e-16)
    right, down = camera.directions([[251.0, 195.0], [250.0, 196.0]])
    assert right[0] == pytest.approx(1 / 900, rel=1e-5)  # to the right of the image: east
    assert down[1] == pytest.approx(-1 / 910, rel=1e-5)  # down the image: south
    np.testing.assert_allclose(
        camera.project([[4.0, -2.0, 0.0], [3.0, -1.0, 0.0]], None), [[280.0, 195.0], [250.0, 195.0 - 910 / 30]]
    )


@pytest.mark.parametrize(
    "water",
    [
        None,
        FlatWater((0.0, 0.0, 1.0), n_water=1.0),
        FlatWater((5.0, 1.0, 1.0), n_water=1.34, slope_x=0.004, slope_y=-0.03),
    ],
    ids=["dry", "index one", "tilted"],
)
@pytest.mark.parametrize("tilt_deg", [0.0, 25.0, 50.0])
def test_a_pixel_comes_back_from_every_height_of_its_path(water, tilt_deg):
    camera = oblique_camera(tilt_deg, heading_deg=33.0)
    pixels = camera.pixel_centres()[::37, ::41]
    path = camera.paths(pixels, water)
    for height in (5.0, 1e-9, 0.0, -1e-9, -1.0, -12.0):
        back = camera.project(path.at_height(height, water), water)
        assert np.abs(back - pixels).max() < PIXEL


def test_water_pulls_the_image_of_the_bed_away_from_the_nadir():
    camera = nadir_camera()
    bed = np.array([13.0, -2.0, -3.0])
    seen = camera.project(bed, FlatWater((0.0, 0.0, 0.0), n_water=1.333))
    dry = camera.project(bed, None)
    assert seen[0] > dry[0] + 1.0
    assert seen[1] == pytest.approx(dry[1], abs=PIXEL)


def test_points_behind_the_camera_are_nan_and_alone():
    camera = nadir_camera()
    points = np.array([[3.0, -2.0, 31.0], [3.0, -2.0, 30.0], [3.0, -2.0, 29.0]])
    np.testing.assert_array_equal(np.isnan(camera.project(points, None)).all(axis=-1), [True, True, False])


def test_a_pixel_is_seen_within_the_image_and_not_where_it_is_unknown():
    camera = nadir_camera()
    pixels = [(0.5, 0.5), (511.9, 383.9), (512.1, 15.0), (20.0, 384.1), (-0.1, 15.0), (np.nan, 15.0)]
    assert camera.sees(pixels).tolist() == [True, True, False, False, False, False]
    assert camera.sees(pixels[0])


def test_pixels_outside_the_image_are_returned_as_they_are():
    u, v = nadir_camera().project(np.array([53.0, -2.0, 0.0]), None)
    assert u == pytest.approx(250.0 + 900.0 * 50.0 / 30.0)
    assert v == pytest.approx(195.0)


@pytest.mark.parametrize("lens", [None, Distortion(BROWN, (-0.2, 0.05, 1e-3, -1e-3, 0.0))], ids=["pinhole", "lens"])
@pytest.mark.parametrize("water", [None, FlatWater((0.0, 0.0, 1.0), n_water=1.34, slope_y=0.02)], ids=["dry", "wet"])
def test_a_rolling_shutter_takes_each_point_at_the_row_at_which_it_appears(rng, water, lens):
    still = replace(oblique_camera(20.0, 70.0), distortion=lens)
    camera = replace(still, motion=np.array([9e-4, -5e-4, 2e-4]))  # 0.4 m from the first row to the last
    points = rng.uniform([-3.0, -8.0, -4.0], [9.0, 4.0, 3.0], (40, 3))

    def row_less(v: float, point: np.ndarray) -> float:
        there = replace(still, centre=camera.centre + (v - camera.cy) * camera.motion)
        return there.project(point, water)[1] - v

    expected = []
    for point in points:
        v = brentq(row_less, -3000.0, 3000.0, args=(point,), xtol=1e-12)
        expected.append(replace(still, centre=camera.centre + (v - camera.cy) * camera.motion).project(point, water))
    found = camera.project(points, water)
    assert np.abs(found - still.project(points, water)).max() > 1.0
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-8)
    for height in (2.0, -3.0):
        back = camera.project(camera.paths(found, water).at_height(np.array(height), water), water)
        np.testing.assert_allclose(back, found, rtol=0.0, atol=1e-6)
    half = camera.scaled(0.5)
    np.testing.assert_allclose(2.0 * half.project(points, water), found, rtol=0.0, atol=1e-8)


@pytest.mark.parametrize("motion", [None, np.array([9e-4, -5e-4, 2e-4])], ids=["global shutter", "rolling shutter"])
def test_a_camera_with_a_tide_sees_the_same_points_through_water_as_much_higher(rng, motion):
    water, tide = FlatWater((0.0, 0.0, 1.0), n_water=1.34, slope_x=0.03, slope_y=0.02), 0.4
    own = replace(water, point=(0.0, 0.0, 1.0 + tide))
    still = replace(oblique_camera(20.0, 70.0), motion=motion)
    camera, points = replace(still, tide=tide), rng.uniform([-3.0, -8.0, -4.0], [9.0, 4.0, 3.0], (40, 3))
    pixels = camera.project(points, water)
    assert np.abs(pixels - still.project(points, water)).max() > 0.5
    np.testing.assert_allclose(pixels, still.project(points, own), rtol=0.0, atol=1e-9)
    found, expected = camera.paths(pixels, water), still.paths(pixels, own)
    for name in ("origin", "crossing", "water_direction", "air_length"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=0.0, atol=1e-12)
    # Heights count from the water that is given, for all photographs alike.
    height = -water.depth(points)
    np.testing.assert_allclose(found.at_height(height, water), points, rtol=0.0, atol=1e-8)
    np.testing.assert_allclose(camera.project(points, None), still.project(points, None), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("factor", [0.5, 0.25, 2.0, 0.3])
def test_a_scaled_camera_sees_the_same_things_at_scaled_pixels(rng, factor):
    camera, water = oblique_camera(15.0, 200.0), FlatWater((0.0, 0.0, 1.0), n_water=1.333)
    small = camera.scaled(factor)
    assert (small.width, small.height) == (int(512 * factor), int(384 * factor))
    points = rng.uniform([-9, -9, -4], [9, 9, 3], (300, 3))
    ratio = np.array([small.width / 512, small.height / 384])
    np.testing.assert_allclose(
        small.project(points, water), camera.project(points, water) * ratio, rtol=1e-12, atol=1e-9
    )
    # A pixel of half the image covers two by two: their common corner is its centre.
    if factor == 0.5:
        np.testing.assert_allclose(small.directions([0.5, 0.5]), camera.directions([1.0, 1.0]), atol=1e-15)


def test_scaling_rounds_down_but_not_past_a_whole_pixel():
    camera = nadir_camera(width=100, height=50)
    assert camera.scaled(0.29).width == 29  # 100 * 0.29 is 28.999999999999996
    assert camera.scaled(0.295).width == 29


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"centre": [1.0, 2.0]}, r"\(2,\)"),
        ({"cam_from_local": np.eye(4)}, r"\(4, 4\)"),
        ({"centre": [1.0, np.nan, 2.0]}, "finite centre"),
        ({"cam_from_local": np.diag([1.0, 1.0, -1.0])}, "right-handed"),
        ({"cam_from_local": 1.01 * np.eye(3)}, "rotation"),
        ({"cam_from_local": np.full((3, 3), np.nan)}, "rotation"),
        ({"tide": np.nan}, "tide"),
        ({"fx": 0.0}, r"fx 0\.0"),
        ({"fy": np.nan}, "fy nan"),
        ({"width": 0}, "0 x 384"),
        ({"motion": [1.0, 2.0]}, r"finite motion \(3,\)"),
        ({"motion": [1.0, np.nan, 0.0]}, "finite motion"),
    ],
)
def test_impossible_cameras_are_refused_with_what_was_found(changes, words):
    with pytest.raises(ValueError, match=words):
        nadir_camera(**changes)
