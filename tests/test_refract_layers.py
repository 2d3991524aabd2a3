"""Parallel layers: against Snell's invariant in exact arithmetic, one interface, and a straight line."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch

from refract import PinholeCamera, crossing_point, project, trace
from refract.layers import ParallelLayers
from refract.surfaces import FlatWater

PORT = ParallelLayers((0.0, 0.0, 0.03), (0.0, 0.0, -1.0), (1.0, 1.5, 1.34), (0.01,))
RAY_RAD = 1e-12


def fan(rng, count, flattest_deg):
    """Unit rays along z, up to an angle from it."""
    angle, turn = np.radians(rng.uniform(0.0, flattest_deg, count)), rng.uniform(0.0, 2.0 * math.pi, count)
    return np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), np.cos(angle)], axis=-1)


def angle_between(a, b):
    return np.linalg.norm(np.cross(a, b), axis=-1) / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)


def invariant_tangent(indices, thicknesses, distance) -> float:
    """Tangent in the first layer, from n_i sin(theta_i) = c and sum h_i tan(theta_i) = D, by bisection for c."""
    with mpmath.workdps(40):
        low, high = mpmath.mpf(0), mpmath.mpf(min(indices))
        for _ in range(200):
            c = (low + high) / 2
            way = sum(
                h * c / mpmath.sqrt(mpmath.mpf(n) ** 2 - c * c) for n, h in zip(indices, thicknesses, strict=True)
            )
            low, high = (c, high) if way < distance else (low, c)
        return float(low / mpmath.sqrt(mpmath.mpf(indices[0]) ** 2 - low * low))


@pytest.mark.parametrize("indices", [(1.0, 1.5, 1.34), (1.52, 1.0, 1.33), (1.34, 1.47, 1.0)])
def test_project_obeys_the_invariant_of_snell(rng, indices):
    layers = ParallelLayers((0.0, 0.0, 0.0), (0.0, 0.0, 2.0), indices, (0.01,))
    for distance in (0.0, 0.01, 0.5, 2.0, 20.0):
        seen = layers.project(np.array([distance, 0.0, -1.01]), np.array([0.0, 0.0, 0.05]))
        expected = invariant_tangent(indices, (0.05, 0.01, 1.0), distance)
        np.testing.assert_allclose(-seen[0] / seen[2], expected, rtol=1e-14, atol=0.0)
        assert seen[1] == 0.0


def test_project_returns_the_traced_ray(rng):
    ray = fan(rng, 2000, 85.0)
    path = PORT.trace(np.zeros(3), ray)
    bed = path.crossings[-1] + 10.0 ** rng.uniform(-2, 2, (2000, 1)) * path.direction
    assert angle_between(PORT.project(bed, np.zeros(3)), ray).max() < RAY_RAD
    np.testing.assert_allclose(np.linalg.norm(path.direction, axis=-1), 1.0, rtol=1e-14)
    np.testing.assert_allclose([c[:, 2].min() for c in path.crossings], [0.03, 0.04], rtol=1e-14)


def test_the_direction_behind_a_pane_is_that_without_it(rng):
    ray = fan(rng, 100, 85.0)
    bare = ParallelLayers(PORT.point, PORT.normal, (1.0, 1.34)).trace(np.zeros(3), ray)
    np.testing.assert_allclose(PORT.trace(np.zeros(3), ray).direction, bare.direction, atol=1e-14)


def test_one_interface_is_flat_water(rng):
    water = FlatWater((1.0, 2.0, 0.5), n_water=1.34, slope_x=0.05, slope_y=-0.02)
    layers = ParallelLayers(water.point, water.up, (1.0, water.n_water))
    camera = np.array([0.0, 0.0, 30.0])
    bed = np.concatenate([rng.uniform(-30, 30, (500, 2)), rng.uniform(-10, -5, (500, 1))], axis=-1)
    expected = crossing_point(bed, camera, water) - camera
    assert angle_between(layers.project(bed, camera), expected).max() < 1e-15


def test_equal_indices_leave_the_ray_as_it_is_to_the_last_bit(rng):
    layers = ParallelLayers((0.0, 0.0, 1.0), (0.1, -0.2, -3.0), (1.34, 1.34, 1.34, 1.34), (0.02, 0.0))
    ray = fan(rng, 200, 60.0)
    np.testing.assert_array_equal(layers.trace(np.zeros(3), ray).direction, ray)
    seen = layers.project(5.0 * ray, np.zeros(3))
    assert angle_between(seen, ray).max() < 4 * np.finfo(np.float64).eps  # two projections on the normal


def test_hard_corners_are_solved():
    """A camera 1 mm from the port and the point far off to the side: the slowest case for Newton's steps."""
    for H, depth, distance in ((1e-3, 1e3, 1200.0), (1e-3, 1e3, 2000.0), (1e-3, 1.0, 50.0), (10.0, 1e-3, 1e3)):
        layers = ParallelLayers((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.0, 1.5, 1.34), (0.01,))
        seen = layers.project(np.array([distance, 0.0, -0.01 - depth]), np.array([0.0, 0.0, H]))
        expected = invariant_tangent((1.0, 1.5, 1.34), (H, 0.01, depth), distance)
        assert abs(math.atan2(seen[0], -seen[2]) - math.atan(expected)) < RAY_RAD


def test_rays_that_cannot_pass_and_points_that_cannot_be_seen_are_nan():
    out = ParallelLayers((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.34, 1.5, 1.0), (0.01,))
    rays = np.array([[0.6, 0.0, -0.8], [0.8, 0.0, -0.6], [0.6, 0.0, 0.8]])  # critical angle: asin(1 / 1.34), 48.3 deg
    path = out.trace(np.array([0.0, 0.0, 1.0]), rays)
    np.testing.assert_array_equal(np.isnan(path.direction[:, 0]), [False, True, True])
    np.testing.assert_array_equal(np.isnan(path.crossings[1][:, 0]), [False, False, True])
    points = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -0.005], [0.0, 0.0, 2.0]])
    seen = out.project(points, np.array([0.0, 0.0, 1.0]))
    np.testing.assert_array_equal(np.isnan(seen[:, 0]), [False, True, True])
    assert np.isnan(out.project(points[0], np.array([0.0, 0.0, -0.5]))).all()


@pytest.mark.parametrize("offset", [0.0, 0.7])
def test_gradients_flow_to_ends_indices_and_glass(offset):
    leaves = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True)
        for v in ([offset, 0.0, 1.5], [0.0, 0.0, 0.0], 1.05, 1.5, 1.34, 0.01, 0.03)
    ]

    def seen(point, camera, n_0, n_1, n_2, glass, gap):
        return ParallelLayers((0.0, 0.0, gap), (0.0, 0.0, -1.0), (n_0, n_1, n_2), (glass,)).project(point, camera)

    def behind(point, camera, n_0, n_1, n_2, glass, gap):
        layers = ParallelLayers((0.0, 0.0, gap), (0.0, 0.0, -1.0), (n_0, n_1, n_2), (glass,))
        path = layers.trace(camera, point / torch.linalg.norm(point))
        return torch.cat([path.direction, path.crossings[1]])

    assert torch.autograd.gradcheck(seen, leaves, eps=1e-6, atol=1e-6)
    assert torch.autograd.gradcheck(behind, leaves, eps=1e-6, atol=1e-6)


def test_drjit_agrees_with_numpy(rng):
    drjit = pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM; install libllvm19 or set DRJIT_LIBLLVM_PATH")
    from drjit.llvm.ad import Array3f64

    ray = fan(rng, 100, 80.0)
    path = PORT.trace(np.zeros(3), ray)
    bed = path.crossings[-1] + path.direction
    twin = PORT.trace(Array3f64(0.0), Array3f64(ray.T))
    np.testing.assert_allclose(np.asarray(twin.direction).T, path.direction, atol=1e-15)
    seen = PORT.project(Array3f64(bed.T), Array3f64(0.0))
    assert angle_between(np.asarray(seen).T, ray).max() < RAY_RAD


def test_points_along_a_path_through_layers_are_where_its_legs_lead(rng):
    ray, origin = fan(rng, 50, 60.0), np.zeros(3)
    path = PORT.trace(origin, ray)
    air, glass = path.lengths
    np.testing.assert_allclose(path.at(air), path.crossings[0], atol=1e-15)
    np.testing.assert_allclose(path.at(air + glass), path.crossings[1], atol=1e-15)
    np.testing.assert_allclose(path.at(air + glass + 2.0), path.crossings[1] + 2.0 * path.direction, atol=1e-14)
    np.testing.assert_allclose(path.at(0.5 * air), 0.5 * path.crossings[0], atol=1e-15)
    seen = project(path.at(air + glass + 2.0), origin, PORT)
    np.testing.assert_allclose(seen.water_length, 2.0, rtol=1e-12)
    np.testing.assert_allclose(path.raised(0.7).at(1.0) - path.at(1.0), np.tile([0.0, 0.0, 0.7], (50, 1)), atol=1e-15)


def test_points_along_rays_that_do_not_pass_all_layers():
    out = ParallelLayers((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), (1.34, 1.5, 1.0), (0.01,))
    rays = torch.tensor([[0.8, 0.0, -0.6], [0.6, 0.0, 0.8], [0.0, 2.0, 0.0]], dtype=torch.float64)
    origin = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    path = trace(origin, rays, out)
    reflected, straight, invalid = path.at(1.0 / 0.6 + 1.0)
    assert torch.isnan(torch.cat([reflected, invalid])).all()
    assert straight.tolist() == pytest.approx([0.6 * (1.0 / 0.6 + 1.0), 0.0, 1.0 + 0.8 * (1.0 / 0.6 + 1.0)])
    (gradient,) = torch.autograd.grad(straight.sum() + path.at(1.0)[0].sum(), origin)
    assert gradient.tolist() == [2.0, 2.0, 2.0]


def test_one_interface_of_layers_is_a_plane_to_every_function(rng):
    layers, flat = (
        ParallelLayers((0.0, 0.0, 0.2), (0.0, 0.0, 1.0), (1.0, 1.34)),
        FlatWater((0.0, 0.0, 0.2), n_water=1.34),
    )
    points, centre = rng.uniform([-20, -20, -9], [20, 20, -2], (30, 3)), np.array([1.0, 2.0, 30.0])
    camera = PinholeCamera(centre, np.diag([1.0, -1.0, -1.0]), 800.0, 800.0, 320.0, 240.0, 640, 480, tide=0.1)
    np.testing.assert_allclose(crossing_point(points, centre, layers), crossing_point(points, centre, flat), atol=1e-12)
    np.testing.assert_allclose(camera.project(points, layers), camera.project(points, flat), atol=1e-9)
    pixels = camera.project(points, flat)
    np.testing.assert_allclose(camera.paths(pixels, layers).at(36.0), camera.paths(pixels, flat).at(36.0), atol=1e-12)


def test_a_camera_behind_a_port_projects_to_the_pixel_of_the_ray(rng):
    camera = PinholeCamera(np.zeros(3), np.eye(3), 800.0, 800.0, 320.0, 240.0, 640, 480)
    pixels = rng.uniform([0.0, 0.0], [640.0, 480.0], (20, 2))
    np.testing.assert_allclose(camera.project(camera.paths(pixels, PORT).at(2.5), PORT), pixels, atol=1e-9)


def test_wrong_stacks_are_named():
    up = (0.0, 0.0, 1.0)
    for arguments, message in (
        (((0, 0, 0), up, (1.0,)), "two media"),
        (((0, 0, 0), up, (1.0, 1.5, 1.33)), r"layers - 2"),
        (((0, 0, 0), up, (1.0, 1.5, 1.33), (-0.01,)), r"-0\.01"),
        (((0, 0, 0), up, (0.9, 1.33)), r"0\.9"),
        (((0, 0, 0), (0, 0, 0), (1.0, 1.33)), "normal with a length"),
        (((0, 0, math.nan), up, (1.0, 1.33)), "finite"),
    ):
        with pytest.raises(ValueError, match=message):
            ParallelLayers(*arguments)
