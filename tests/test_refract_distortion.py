"""Distortion of lenses: against OpenCV and COLMAP, back and forth, where a model folds back, and in three libraries."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from surface_rays import SINGLE, array_of, as_double

from refract import FlatWater
from refract.distortion import AFFINE, BROWN, FISHEYE, RATIONAL, Distortion, distort, kinds_of, row_of, undistort
from refract.lens import Lens, affine_from_brown, brown_from_affine, distorted, normalised, undistorted

BARREL = Distortion(BROWN, (-0.12, 0.03, 1e-3, -2e-3, -0.004))
PINCUSHION = Distortion(BROWN, (0.15, 0.02, 1e-3, -1e-3, 0.0))
FULL = Distortion(RATIONAL, (0.1, -0.05, 5e-4, 3e-4, 0.01, 0.2, 0.01, 1e-3))
ROUND = Distortion(FISHEYE, (0.02, -0.01, 0.002, 0.001))
SHEARED = Distortion(AFFINE, (-0.12, 0.03, 1e-3, -2e-3, -0.004, 0.006, 3e-3))
ALL = {"barrel": BARREL, "pincushion": PINCUSHION, "rational": FULL, "fisheye": ROUND, "affine": SHEARED}
# A few roundings of numbers near one; measured 7e-16.
EXACT = 4e-15
# Newton's method ends below a hundred roundings; measured 4e-15.
SOLVED = 2e-13
# Ten float32 operations on numbers near one; measured 3e-7.
SINGLE_PX = 1e-6

LENSES = [
    Lens("SIMPLE_RADIAL", (350.0, 160.0, 120.0, -0.12), 320, 240),
    Lens("RADIAL", (350.0, 161.3, 118.2, -0.12, 0.04), 320, 240),
    Lens("OPENCV", (350.0, 352.0, 158.7, 121.2, -0.15, 0.05, 0.001, -0.002), 320, 240),
    Lens("OPENCV_FISHEYE", (250.0, 250.0, 160.0, 120.0, 0.02, -0.01, 0.002, 0.001), 320, 240),
    Lens("FULL_OPENCV", (350.0, 351.0, 160.0, 120.0, 0.1, -0.05, 5e-4, 3e-4, 0.01, 0.2, 0.01, 1e-3), 320, 240),
]
AFFINE_LENS = Lens("BROWN_AFFINE", (350.0, 351.0, 160.0, 120.0, -0.1, 0.05, 5e-4, 3e-4, 0.01, 0.02, 2e-3), 320, 240)


def by_opencv(distortion: Distortion, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    coefficients = np.array(distortion.coefficients)
    if distortion.kind == FISHEYE:
        return cv2.fisheye.distortPoints(np.stack([x, y], -1)[:, None], np.eye(3), coefficients)[:, 0]
    if distortion.kind == AFFINE:
        # OpenCV has no such lens: its Brown's, and by hand what Metashape adds to that.
        k4, skew = coefficients[5:]
        brown = by_opencv(Distortion(BROWN, distortion.coefficients[:5]), x, y)
        xd, yd = brown.T + k4 * (x * x + y * y) ** 4 * np.array([x, y])
        return np.stack([xd + skew * yd, yd], -1)
    points = np.stack([x, y, np.ones_like(x)], -1)
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0][:, 0]


def places(rng, most: float = 0.8) -> np.ndarray:
    """Normalised coordinates (2, 500), the axis itself among them."""
    found = rng.uniform(-most, most, (2, 500))
    found[:, 0] = 0.0
    return found


@pytest.mark.parametrize("distortion", ALL.values(), ids=ALL.keys())
def test_rays_are_distorted_as_opencv_does_and_come_back(distortion, rng):
    x, y = places(rng)
    bent = np.stack(distortion.distorted(x, y), -1)
    np.testing.assert_allclose(bent, by_opencv(distortion, x, y), rtol=0.0, atol=EXACT)
    # A test that would not see the distortion proves nothing.
    assert np.abs(bent.T - [x, y]).max() > 0.02
    np.testing.assert_allclose(distortion.undistorted(*bent.T), [x, y], rtol=0.0, atol=SOLVED)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_a_camera_sees_what_that_of_colmap_sees_and_its_rays_return(lens, rng):
    turn = Rotation.from_euler("zx", [30.0, 160.0], degrees=True).as_matrix()
    camera = lens.camera(np.array([1.0, 2.0, 20.0]), turn)
    rays = np.concatenate([rng.uniform((-0.45, -0.34), (0.45, 0.34), (300, 2)), np.ones((300, 1))], axis=-1)
    points = camera.centre + 15.0 * rays @ turn
    theirs = pycolmap.Camera(model=lens.model, width=lens.width, height=lens.height, params=list(lens.params))
    expected = theirs.img_from_cam(rays)
    pinhole = lens.pinhole(camera.centre, turn)
    assert np.abs(pinhole.project(points, None) - expected).max() > 1.0
    np.testing.assert_allclose(camera.project(points, None), expected, rtol=0.0, atol=1e-9)
    water = FlatWater((0.0, 0.0, 10.0), n_water=1.34)
    paths = camera.paths(expected, water)
    np.testing.assert_allclose(camera.project(paths.at_height(np.array(-3.0), water), water), expected, atol=1e-8)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_half_the_image_shows_the_same_at_half_the_pixels(lens):
    camera = lens.camera(np.zeros(3), np.diag([1.0, -1.0, -1.0]))
    pixels = camera.pixel_centres()[::17, ::13]
    np.testing.assert_allclose(camera.scaled(0.5).directions(0.5 * pixels), camera.directions(pixels), atol=1e-14)


def test_lenses_whose_coefficients_are_zero_are_pinholes():
    lens = Lens("OPENCV", (100.0, 101.0, 32.0, 24.0, 0.0, 0.0, 0.0, 0.0), 64, 48)
    assert lens.camera(np.zeros(3), np.eye(3)).distortion is None
    assert kinds_of([None, None]) == frozenset()


def test_beyond_the_place_where_a_polynomial_folds_back_nothing_is_seen():
    # r (1 - 0.9 r^2) turns back at r = 0.61, distorted 0.41.
    lens = Lens("SIMPLE_RADIAL", (100.0, 64.0, 48.0, -0.9), 128, 96)
    camera = lens.camera(np.zeros(3), np.eye(3))
    turn = 1.0 / math.sqrt(3.0 * 0.9)
    assert camera.distortion.reach == pytest.approx(turn, abs=1e-9)
    pixels = camera.pixel_centres()
    lit = np.isfinite(camera.directions(pixels)).all(axis=-1)
    radius = np.hypot(*((pixels - (64.0, 48.0)) / 100.0).transpose(2, 0, 1))
    np.testing.assert_array_equal(lit, radius < turn * (1.0 - 0.9 * turn**2))
    # Without the reach the second would appear at the middle of the image.
    seen = camera.project([[0.99 * turn, 0.0, 1.0], [1.0 / math.sqrt(0.9), 0.0, 1.0]], None)
    np.testing.assert_array_equal(np.isfinite(seen).all(axis=-1), [True, False])


def test_a_fisheye_lens_ends_where_its_angle_turns_back():
    # The derivative of t - 0.3 t^3 vanishes at t^2 = 1 / 0.9.
    ends = Distortion(FISHEYE, (-0.3, 0.0, 0.0, 0.0))
    assert math.atan(ends.reach) == pytest.approx(math.sqrt(1.0 / 0.9), abs=1e-9)
    assert math.degrees(math.atan(ROUND.reach)) == pytest.approx(89.0)


def test_a_rational_lens_ends_before_its_pole():
    ends = Distortion(RATIONAL, (0.0, 0.0, 0.0, 0.0, 0.0, -0.5, 0.0, 0.0))
    assert ends.reach < math.sqrt(2.0)
    assert np.isnan(ends.distorted(np.array([1.5]), np.array([0.0]))).all()


@pytest.mark.parametrize("library", SINGLE)
@pytest.mark.parametrize("distortion", ALL.values(), ids=ALL.keys())
def test_every_library_distorts_alike(distortion, library, rng):
    x, y = places(rng)
    kinds, truth = {distortion.kind}, distortion.distorted(x, y)
    found = distort(kinds, array_of(library, x), array_of(library, y), distortion.row)
    np.testing.assert_allclose([as_double(v) for v in found], truth, rtol=0.0, atol=SINGLE_PX)
    back = undistort(kinds, *(array_of(library, v) for v in truth), distortion.row)
    np.testing.assert_allclose([as_double(v) for v in back], [x, y], rtol=0.0, atol=4.0 * SINGLE_PX)


@pytest.mark.parametrize("library", ["numpy", *SINGLE])
@pytest.mark.parametrize(
    "lenses",
    [(None, BARREL, FULL, ROUND), (None, BARREL, FULL, ROUND, SHEARED), (None, BARREL, ROUND, SHEARED)],
    ids=["opencv", "all", "without rational"],
)
def test_lenses_of_several_kinds_among_the_rays_each_keep_their_own(lenses, library, rng):
    x, y = places(rng)
    which = rng.integers(0, len(lenses), x.size)
    lens_rows = np.array([row_of(lens) for lens in lenses])[which].T
    expected = np.stack([x, y])
    for k, lens in enumerate(lenses):
        if lens is not None:
            expected[:, which == k] = lens.distorted(x[which == k], y[which == k])
    found = distort(
        kinds_of(lenses), array_of(library, x), array_of(library, y), [array_of(library, row) for row in lens_rows]
    )
    np.testing.assert_allclose([as_double(v) for v in found], expected, rtol=0.0, atol=SINGLE_PX)


def test_a_bent_border_has_places_between_its_corners_and_reaches_as_far_as_it_looks():
    lens = LENSES[2]
    camera, pinhole = (make(np.zeros(3), np.eye(3)) for make in (lens.camera, lens.pinhole))
    assert len(pinhole.outline()) == 4
    assert {tuple(p) for p in pinhole.outline()} <= {tuple(p) for p in camera.outline()}
    assert pinhole.widening == 1.0
    rays = camera.directions(camera.pixel_centres())
    farthest = np.hypot(rays[..., 0], rays[..., 1]).max() / rays[..., 2].min()
    assert camera.widening * np.hypot(158.7 / 350.0, 121.2 / 352.0) > 0.99 * farthest
    wide = replace(camera, distortion=replace(ROUND, coefficients=(0.5, 0.0, 0.0, 0.0)))
    assert wide.widening >= 1.0


@pytest.mark.parametrize(
    ("kind", "coefficients", "words"),
    [
        ("prism", (), "of kind prism is not known, expected one of brown, rational, fisheye"),
        (BROWN, (0.1, 0.2), "expected 5 finite coefficients of brown, got"),
        (FISHEYE, (0.1, math.nan, 0.0, 0.0), "expected 4 finite coefficients of fisheye"),
    ],
)
def test_numbers_that_are_no_distortion_are_refused(kind, coefficients, words):
    with pytest.raises(ValueError, match=words):
        Distortion(kind, coefficients)


def test_the_affine_lens_takes_pixels_there_and_back_as_its_camera_does(rng):
    pixels = rng.uniform((0.0, 0.0), (320.0, 240.0), (300, 2))
    plane = undistorted(AFFINE_LENS, pixels)
    camera = AFFINE_LENS.camera(np.zeros(3), np.eye(3))
    rays = camera.directions(pixels)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, rtol=0.0, atol=SOLVED)
    straight = plane * AFFINE_LENS.focal + (160.0, 120.0)
    np.testing.assert_allclose(distorted(AFFINE_LENS, straight), pixels, rtol=0.0, atol=1e-10)
    assert np.abs(straight - pixels).max() > 1.0
    _, change = normalised(AFFINE_LENS)
    assert change.shape == (320 * 240, 2, 2)


def test_an_affine_lens_without_its_two_terms_is_browns(rng):
    pixels = rng.uniform((0.0, 0.0), (320.0, 240.0), (300, 2))
    brown = Lens("OPENCV", (*AFFINE_LENS.params[:8],), 320, 240)
    k3, k4, skew = AFFINE_LENS.params[8:]
    by_k3 = Lens("FULL_OPENCV", (*brown.params, k3, 0.0, 0.0, 0.0), 320, 240)
    without = brown_from_affine(AFFINE_LENS, pixels)
    assert np.abs(without - pixels).max() > 0.1
    np.testing.assert_allclose(undistorted(by_k3, without), undistorted(AFFINE_LENS, pixels), rtol=0.0, atol=1e-9)
    np.testing.assert_allclose(affine_from_brown(AFFINE_LENS, without), pixels, rtol=0.0, atol=1e-8)
    assert k4 != 0.0 != skew


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.model)
def test_no_pixels_are_no_pixels_through_any_lens(lens):
    none = np.empty((0, 2))
    assert distorted(lens, none).shape == undistorted(lens, none).shape == (0, 2)
