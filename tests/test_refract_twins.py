"""One source, three libraries: torch and Dr.Jit against float64 numpy, and gradients against differences."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from refract import FlatWater, bend, crossing_point, kernels

EPS32 = np.finfo(np.float32).eps
FOCAL_PX = 1750.0  # of a drone camera; one radian off the axis is this many pixels
# Worst angle [rad] in float32 over the drone geometry below, and where it comes from; measured times two.
BY_STEPS = {
    1: 1.6e-5,  # the iteration: 8.0e-6 at 5 m over 15 m of water, 1.8e-7 rms
    2: 4 * EPS32,  # rounding: 1.1e-7 and less
    4: 4 * EPS32,
}
UP = (0.0, 0.0, 1.0)
PLANE = kernels.WaterPlane((0.0, 0.0, 0.0), UP, 1.333)


def drone_geometry(rng, count=20_000):
    """Cameras 5 to 120 m over the water, beds 0 to 15 m under it, incidence to 50 deg: triples of float64.

    Camera and point stand about local (0, 0), so that float32 keeps the digits that the test is about.
    """
    H, h = rng.uniform(5.0, 120.0, count), rng.uniform(0.0, 15.0, count)
    angle, azimuth = np.radians(rng.uniform(0.0, 50.0, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    D = H * np.tan(angle) + h * np.sin(angle) / np.sqrt(1.333**2 - np.sin(angle) ** 2)
    zero = np.zeros(count)
    return (zero, zero, H), (D * np.cos(azimuth), D * np.sin(azimuth), -h)


def view_error(crossing, reference, camera):
    """Angles [rad] between the directions of view to two sets of crossings, triples of numpy arrays."""
    seen, true = (np.stack(np.broadcast_arrays(*x), -1) - np.stack(camera, -1) for x in (crossing, reference))
    cross = np.linalg.norm(np.cross(seen, true), axis=-1)
    return cross / np.linalg.norm(seen, axis=-1) / np.linalg.norm(true, axis=-1)


def as_numpy(triple):
    return tuple(np.asarray(c, dtype=np.float64) for c in triple)


@pytest.mark.parametrize("library", ["torch", "drjit"])
@pytest.mark.parametrize("steps", BY_STEPS)
def test_float32_crossings_agree_with_float64_numpy(rng, request, steps, library):
    wrap = request.getfixturevalue("Float") if library == "drjit" else lambda v: torch.tensor(v, dtype=torch.float32)
    camera, point = drone_geometry(rng)
    exact, _ = kernels.crossing_of_point(camera, point, PLANE, 16)
    found, depth = kernels.crossing_of_point(tuple(map(wrap, camera)), tuple(map(wrap, point)), PLANE, steps)
    assert view_error(as_numpy(found), exact, camera).max() < BY_STEPS[steps]
    np.testing.assert_array_equal(np.asarray(depth), np.float32(-point[2]))


@pytest.mark.parametrize("library", ["torch", "drjit"])
def test_bent_rays_agree_with_float64_numpy(rng, request, library):
    wrap = request.getfixturevalue("Float") if library == "drjit" else torch.tensor
    ray = rng.normal(size=(10_000, 3)).astype(np.float32)
    ray[:, 2] = -np.abs(ray[:, 2])
    ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
    for n_from, n_to in ((1.0, 1.333), (1.333, 1.0)):
        exact = np.stack(kernels.bend(tuple(ray.T.astype(np.float64)), UP, n_from, n_to), -1)
        found = kernels.bend(tuple(wrap(np.ascontiguousarray(c)) for c in ray.T), UP, n_from, n_to)
        found = np.stack(as_numpy(found), -1)
        # Out of the water the cosine is the root of a small difference: its error grows as EPS / cosine.
        cosine = np.where(np.isnan(exact[:, 2]), 1.0, -exact[:, 2])
        firm = (cosine > 1e-2) & (np.isfinite(exact[:, 2]) == np.isfinite(found[:, 2]))
        assert firm.mean() > 0.99
        error = np.abs(found - exact)[firm & np.isfinite(exact[:, 2])].max(axis=-1)
        assert (error * cosine[firm & np.isfinite(exact[:, 2])]).max() < 8 * EPS32


def test_drjit_drops_totally_reflected_rays_without_poisoning_gradients(Float):
    import drjit

    angle = np.radians([20.0, 60.0])
    ray = tuple(Float(c) for c in (np.sin(angle), np.zeros(2), -np.cos(angle)))
    drjit.enable_grad(*ray)
    bent = kernels.bend(ray, UP, 1.333, 1.0)
    np.testing.assert_array_equal(np.isnan(np.asarray(bent[0])), [False, True])
    drjit.backward(drjit.select(drjit.isnan(bent[0]), 0.0, bent[0]))
    gradient = np.asarray(drjit.grad(ray[0]))
    assert gradient[0] > 1.0
    assert gradient[1] == 0.0


@pytest.mark.parametrize("z", [0.0, -0.0, 2.0])
def test_gradients_at_and_above_the_shoreline_are_those_of_a_straight_ray(z):
    points = torch.tensor([[0.0, 0.0, z], [5.0, 1.0, z]], dtype=torch.float64, requires_grad=True)
    camera = torch.tensor([0.0, 0.0, 30.0], dtype=torch.float64, requires_grad=True)
    crossing_point(points, camera, FlatWater((0.0, 0.0, 0.0), n_water=1.333)).sum().backward()
    np.testing.assert_array_equal(points.grad, np.ones((2, 3)))
    np.testing.assert_array_equal(camera.grad, np.zeros(3))


@pytest.mark.parametrize(
    ("n_from", "n_to", "angle_deg"),
    [(1.0, 1.333, a) for a in (0.0, 1e-6, 30.0, 48.0, 80.0, 89.0)]
    + [(1.333, 1.0, a) for a in (0.0, 1e-6, 30.0, 48.0)]  # up to the critical angle, 48.6 deg
    + [(1.333, 1.333, a) for a in (0.0, 30.0, 89.0)],
)
def test_bend_has_the_right_gradient_in_ray_normal_and_index(n_from, n_to, angle_deg):
    angle = math.radians(angle_deg)
    leaves = [
        torch.tensor(v, dtype=torch.float64, requires_grad=True)
        for v in ([math.sin(angle), 0.0, -math.cos(angle)], [0.0, 0.0, 1.0], n_from)
    ]
    # The kernel does not renormalise: it is differentiated as the function of three free components that it is.
    assert torch.autograd.gradcheck(
        lambda ray, normal, index: bend(ray, normal, n_from=index, n_to=n_to), leaves, eps=1e-7, atol=1e-5
    )


def test_numpy_cameras_mix_with_torch_points():
    points = torch.tensor([[1.0, 2.0, -3.0]], dtype=torch.float32)
    found = crossing_point(points, np.array([0.0, 0.0, 30.0]), FlatWater((0.0, 0.0, 0.0), n_water=1.333))
    assert torch.is_tensor(found)
    assert found.dtype == torch.float32
    assert found.shape == (1, 3)
