"""Apparent depth: closed forms against pairs of traced rays and against the caustic."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from slow_reference import meeting_of_lines

from refract import (
    FlatWater,
    PinholeCamera,
    apparent_depth,
    apparent_depth_tangential,
    crossing_point,
    tangential_shift,
    trace,
    true_depth,
)

CLOSED = 1e-12  # relative: coordinates of some 10 m, depths of 3 m, a few dozen roundings
N, H, DEPTH = 1.333, 12.0, 3.0
WATER = FlatWater((0.0, 0.0, 0.0), n_water=N)
ANGLES_DEG = [5.0, 10.0, 20.0, 30.0, 40.0, 45.0, 60.0, 75.0]


def camera_and_ray(angle):
    """A camera at x < 0 that sees the bed point (0, 0, -DEPTH) at incidence `angle` [rad], and its ray."""
    ray = np.array([math.sin(angle), 0.0, -math.cos(angle)])
    way = trace(np.array([0.0, 0.0, H]), ray, WATER).at_height(-DEPTH, WATER)[0]
    return np.array([-way, 0.0, H]), ray


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_rays_from_opposite_sides_meet_at_the_sagittal_depth(angle_deg):
    angle = math.radians(angle_deg)
    centre, ray = camera_and_ray(angle)
    mirror = np.array([-1.0, 1.0, 1.0])
    met = meeting_of_lines([centre, centre * mirror], [ray, ray * mirror])
    assert -met[2] == pytest.approx(apparent_depth(DEPTH, angle, n_water=N), rel=CLOSED)
    assert abs(met[0]) < CLOSED


@pytest.mark.parametrize("angle_deg", ANGLES_DEG)
def test_the_caustic_lies_at_the_tangential_depth_and_shift(angle_deg):
    """Neighbouring rays of one vertical plane touch where ``x(s) + z s`` is stationary, s the slope in air."""
    angle = math.radians(angle_deg)
    camera_x = torch.tensor(camera_and_ray(angle)[0][0], dtype=torch.float64, requires_grad=True)
    centre = torch.stack([camera_x, camera_x * 0.0, camera_x * 0.0 + H])
    bed = torch.tensor([0.0, 0.0, -DEPTH], dtype=torch.float64)
    crossing = crossing_point(bed, centre, WATER)[0]
    slope = (crossing - camera_x) / H
    d_crossing = torch.autograd.grad(crossing, camera_x, retain_graph=True)[0]
    d_slope = torch.autograd.grad(slope, camera_x)[0]
    depth = (-d_crossing / d_slope).item()
    x, slope = crossing.detach().item(), slope.detach().item()
    assert slope == pytest.approx(math.tan(angle), rel=CLOSED)
    assert depth == pytest.approx(apparent_depth_tangential(DEPTH, angle, n_water=N), rel=CLOSED)
    # Toward the camera, which stands at negative x; metres are subtracted to leave as little as a millimetre.
    assert -(x + depth * slope) == pytest.approx(tangential_shift(DEPTH, angle, n_water=N), abs=CLOSED * H)


@pytest.mark.parametrize(
    ("angle_deg", "sagittal", "tangential", "shift", "small_angle"),
    [
        (0, 0.7502, 0.7502, 0.0, 1.000),
        (10, 0.7451, 0.7351, 0.0018, 0.9933),
        (20, 0.7294, 0.6894, 0.0145, 0.9722),
        (30, 0.7009, 0.6117, 0.0515, 0.9342),
        (40, 0.6560, 0.5016, 0.1296, 0.8744),
        (45, 0.6258, 0.4354, 0.1904, 0.8341),
        (60, 0.4934, 0.2134, 0.4849, 0.6577),
    ],
)
def test_published_table_for_fresh_water(angle_deg, sagittal, tangential, shift, small_angle):
    angle, rounded = math.radians(angle_deg), 5.1e-5
    assert apparent_depth(1.0, angle, n_water=N) == pytest.approx(sagittal, abs=rounded)
    assert apparent_depth_tangential(1.0, angle, n_water=N) == pytest.approx(tangential, abs=rounded)
    assert tangential_shift(1.0, angle, n_water=N) == pytest.approx(shift, abs=rounded)
    assert N * apparent_depth(1.0, angle, n_water=N) == pytest.approx(small_angle, abs=rounded)


@pytest.mark.parametrize(
    ("angle_deg", "factor"), [(5, 1.337), (10, 1.344), (15, 1.356), (20, 1.373), (25, 1.397), (30, 1.429)]
)
def test_published_factors_for_an_index_of_1_335(angle_deg, factor):
    assert true_depth(1.0, math.radians(angle_deg), n_water=1.335) == pytest.approx(factor, abs=6e-4)


def sample_camera(row) -> PinholeCamera:
    """A camera of the sample of pyBathySfM: its Euler angles turn north, east, up; 8.8 mm over 13.2 x 8.8 mm."""
    yaw = row["yaw"] if row["yaw"] <= 180.0 else row["yaw"] - 360.0
    turn = Rotation.from_euler("ZYX", [yaw, 90.0 - row["pitch"], -row["roll"]], degrees=True).as_matrix()
    forward, side, up = turn.T[:, [1, 0, 2]]
    return PinholeCamera(
        [row["x"], row["y"], row["z"]], np.stack([side, -up, forward]), 880.0, 880.0, 660.0, 440.0, 1320, 880
    )


def test_corrections_of_another_package_are_met_camera_by_camera(data_dir):
    """pyBathySfM corrects each point once per camera that sees it, at the incidence there: `true_depth`."""
    folder = data_dir / "real" / "pyBathySfM"
    points = np.genfromtxt(folder / "SamplePoints_recovered.csv.gz", delimiter=",", names=True)
    theirs = np.genfromtxt(folder / "pyBathySfM_output_n1.337.csv.gz", delimiter=",", names=True)
    rows = np.genfromtxt(folder / "BathySfM_SampleCameras.csv", delimiter=",", names=True, usecols=range(1, 7))
    xyz = np.stack([points["x"], points["y"], points["sfm_z"]], axis=-1)
    # Their footprints lie at the mean height of the first 10 000 points.
    ground = np.concatenate([xyz[:, :2], np.full((len(xyz), 1), xyz[:10_000, 2].mean())], axis=-1)
    depths = np.full((len(rows), len(xyz)), np.nan)
    near = np.zeros(depths.shape, dtype=bool)
    for row, depth, kept in zip(rows, depths, near, strict=True):
        camera = sample_camera(row)
        pixels = camera.project(ground, None)
        seen = ((pixels > 0.0) & (pixels < (camera.width, camera.height))).all(axis=-1)
        way = camera.centre - xyz
        distance = np.hypot(way[:, 0], way[:, 1])
        angle = np.arctan2(distance, way[:, 2])
        depth[seen] = true_depth(points["w_surf"] - points["sfm_z"], angle, n_water=1.337)[seen]
        kept[:] = (angle <= np.radians(35.0)) & (distance <= 100.0)
    np.testing.assert_array_equal(np.isfinite(depths).sum(axis=0), theirs["n_cams"])
    rounded = 5.1e-6  # five decimals
    np.testing.assert_allclose(np.nanmin(depths, axis=0), theirs["h_min"], rtol=0.0, atol=rounded)
    np.testing.assert_allclose(np.nanmax(depths, axis=0), theirs["h_max"], rtol=0.0, atol=rounded)
    np.testing.assert_allclose(np.nanmean(depths, axis=0), theirs["h_avg"], rtol=0.0, atol=rounded)
    filtered = np.nanmean(np.where(near, depths, np.nan), axis=0)
    np.testing.assert_allclose(filtered, theirs["h_filt"], rtol=0.0, atol=rounded)


def test_true_depth_undoes_apparent_depth():
    angle = np.radians(np.linspace(0.0, 89.0, 500))
    back = true_depth(apparent_depth(DEPTH, angle, n_water=N), angle, n_water=N)
    np.testing.assert_allclose(back, DEPTH, rtol=CLOSED)


def test_nadir_and_index_one_are_exact():
    for form in (apparent_depth, apparent_depth_tangential):
        assert form(DEPTH, 0.0, n_water=N) == pytest.approx(DEPTH / N, rel=1e-15)
        np.testing.assert_allclose(form(DEPTH, np.radians(ANGLES_DEG), n_water=1.0), DEPTH, rtol=CLOSED)
    assert tangential_shift(DEPTH, 0.0, n_water=N) == 0.0


def test_torch_takes_gradients_through_the_closed_forms():
    depth = torch.tensor(3.0, dtype=torch.float64, requires_grad=True)
    angle = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    for form in (apparent_depth, apparent_depth_tangential, tangential_shift, true_depth):
        expected = float(form(3.0, 0.5, n_water=N))
        assert form(depth, angle, n_water=N).detach().item() == pytest.approx(expected, rel=1e-15)
        assert torch.autograd.gradcheck(lambda d, a, form=form: form(d, a, n_water=N), (depth, angle))
