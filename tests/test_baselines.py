"""Baselines against closed forms and the brute-force predictions for whole networks of cameras."""

import gzip

import numpy as np
import pytest
from baselines import apparent_points, per_camera, times_index
from scipy.optimize import brentq

N_WATER = 1.333
HEIGHT, DEPTH = 39.0, 3.5
# The predictions are given to a millimetre.
ROUNDED_M = 0.6e-3


def _crossing(distance: float, height: float, depth: float) -> float:
    """Distance from the camera at which light crosses the surface, by bisection of Snell's law."""
    if distance == 0.0:
        return 0.0

    def excess(r):
        return r / np.hypot(r, height) - N_WATER * (distance - r) / np.hypot(distance - r, depth)

    return brentq(excess, 0.0, distance, xtol=1e-14)


def _rays(cameras: np.ndarray, depth: float):
    """Centres (1, V, 3), directions in air (1, V, 3) and mask of cameras that see the point under the origin."""
    distance = np.hypot(cameras[:, 0], cameras[:, 1])
    share = np.array([_crossing(d, h, depth) / d if d else 0.0 for d, h in zip(distance, cameras[:, 2], strict=True)])
    crossings = np.column_stack([cameras[:, :2] * (1.0 - share)[:, None], np.zeros(len(cameras))])
    directions = crossings - cameras
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return cameras[None], directions[None], np.ones((1, len(cameras)), dtype=bool)


def _block(rows, columns, half_x, half_y):
    x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT)])


def _ring(angle, num=12, depth=DEPTH):
    """Cameras around the origin that see the bed at one incidence [rad]."""
    distance = HEIGHT * np.tan(angle) + depth * np.tan(np.arcsin(np.sin(angle) / N_WATER))
    azimuth = 2.0 * np.pi * np.arange(num) / num
    return np.column_stack([distance * np.cos(azimuth), distance * np.sin(azimuth), np.full(num, HEIGHT)])


def _errors(cameras, depth=DEPTH):
    """Heights [m] over the bed of the straight rays' point, of it times n, and of Dietrich's correction."""
    centres, directions, seen = _rays(cameras, depth)
    apparent = apparent_points(centres, directions, seen)
    to_camera = centres - apparent[:, None]
    incidence = np.arccos(to_camera[..., 2] / np.linalg.norm(to_camera, axis=-1))
    h = -apparent[:, 2]
    return [float(depth - value[0]) for value in (h, times_index(h, N_WATER), per_camera(h, incidence, seen, N_WATER))]


@pytest.mark.parametrize(
    ("cameras", "straight", "times_n", "dietrich"),
    [(_block(4, 5, 8.0, 6.0), 0.897, 0.031, 0.008), (_block(5, 5, 22.0, 22.0), 1.059, 0.246, 0.053)],
    ids=["nadir block", "wide block"],
)
def test_networks_give_the_predicted_errors(cameras, straight, times_n, dietrich):
    np.testing.assert_allclose(_errors(cameras), [straight, times_n, dietrich], atol=ROUNDED_M)


@pytest.mark.parametrize("degrees", [0.5, 10.0, 30.0, 45.0, 60.0])
def test_a_ring_sees_the_sagittal_depth_and_dietrich_undoes_it(degrees):
    """Rays of a symmetric ring meet exactly, at h cos(a) / sqrt(n^2 - sin^2 a)."""
    angle = np.radians(degrees)
    straight, times_n, dietrich = _errors(_ring(angle))
    sagittal = DEPTH * np.cos(angle) / np.sqrt(N_WATER**2 - np.sin(angle) ** 2)
    assert straight == pytest.approx(DEPTH - sagittal, abs=1e-9)
    assert times_n == pytest.approx(DEPTH - N_WATER * sagittal, abs=1e-9)
    assert dietrich == pytest.approx(0.0, abs=1e-9)


def test_two_cameras_side_by_side_see_the_tangential_depth():
    """On the caustic: h n^2 cos^3(a) / (n^2 - sin^2 a)^(3/2), with cameras close together."""
    angle = np.radians(30.0)
    cameras = np.concatenate([_ring(angle + d, num=1) for d in (-1e-4, 1e-4)])
    expected = DEPTH * N_WATER**2 * np.cos(angle) ** 3 / (N_WATER**2 - np.sin(angle) ** 2) ** 1.5
    # The next term of the caustic is of the order of the squared difference of angles.
    assert _errors(cameras)[0] == pytest.approx(DEPTH - expected, abs=1e-6)


def test_straight_rays_in_air_meet_where_the_point_is(rng):
    points = rng.uniform(-5.0, 5.0, (50, 3))
    centres = rng.uniform(-10.0, 10.0, (50, 6, 3)) + np.array([0.0, 0.0, 30.0])
    directions = points[:, None] - centres
    directions /= np.linalg.norm(directions, axis=-1, keepdims=True)
    seen = rng.random((50, 6)) < 0.7
    seen[0], seen[1] = False, np.arange(6) == 2
    found = apparent_points(centres, directions, seen)
    enough = seen.sum(axis=1) >= 2
    np.testing.assert_allclose(found[enough], points[enough], atol=1e-8)
    assert np.isnan(found[~enough]).all()


def test_parallel_rays_meet_nowhere():
    centres = np.array([[[0.0, 0, 10], [1.0, 0, 10], [0, 2.0, 10]]])
    directions = np.tile([0.0, 0.0, -1.0], (1, 3, 1))
    assert np.isnan(apparent_points(centres, directions, np.ones((1, 3), bool))).all()


def test_the_correction_by_every_camera_is_that_of_pybathysfm(data_dir):
    """A stream from 31 cameras; pyBathySfM's ``h_filt``: cameras within 35 degrees and 100 m that have it in frame."""
    folder = data_dir / "real" / "pyBathySfM"
    with gzip.open(folder / "pyBathySfM_output_n1.337.csv.gz", "rt") as stream:
        table = np.genfromtxt(stream, delimiter=",", names=True)[::40]
    table = table[table["h_a"] > 0.1]
    cameras = np.genfromtxt(folder / "BathySfM_SampleCameras.csv", delimiter=",", names=True)
    points = np.column_stack([table["x"], table["y"], table["sfm_z"]])
    away = points[:, None] - np.column_stack([cameras["x"], cameras["y"], cameras["z"]])
    # Frames of 13.2 by 8.8 mm behind 8.8 mm, turned by the yaw; pitch and roll, below a degree, are passed over.
    yaw = np.radians(cameras["yaw"])
    forward = away[..., 0] * np.sin(yaw) + away[..., 1] * np.cos(yaw)
    right = away[..., 0] * np.cos(yaw) - away[..., 1] * np.sin(yaw)
    in_frame = (np.abs(right) < -0.75 * away[..., 2]) & (np.abs(forward) < -0.5 * away[..., 2])
    incidence = np.arctan2(np.hypot(away[..., 0], away[..., 1]), -away[..., 2])
    near = np.linalg.norm(away, axis=-1) <= 100.0
    found = per_camera(table["h_a"], incidence, in_frame & near & (incidence <= np.radians(35.0)), 1.337)
    share = np.abs(found - table["h_filt"]) / table["h_a"]
    # Its table has five digits after the point; a point at the rim of a frame may have a camera more or less.
    assert np.isfinite(share).all()
    assert np.quantile(share, 0.99) < 1e-4
    assert np.median(found / table["h_a"]) == pytest.approx(1.387, abs=0.007)
