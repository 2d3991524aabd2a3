"""Derivatives of bent paths, and one source in three libraries: against differences, fifty digits and float64."""

import math

import mpmath
import numpy as np
import pytest
import torch
from fifty_digits import exact_derivatives, worst
from torch.func import hessian, jacfwd, jacrev, jvp, vmap

from refract import FlatWater, bend, crossing_point, kernels, project, trace

# Central differences with steps of 1e-6 of values of about one: third derivatives and rounding leave 1e-9.
DIFFERENCES = {"eps": 1e-6, "atol": 1e-7, "rtol": 1e-6}


def leaf(value, dtype=torch.float64):
    return torch.tensor(value, dtype=dtype, requires_grad=True)


def traced(origin, ray, z, n, slope_x, slope_y):
    water = FlatWater((0.3, -0.2, z), n_water=n, slope_x=slope_x, slope_y=slope_y)
    path = trace(origin, ray, water)
    return path.crossing, path.air_length, path.water_direction, path.at_height(-2.0, water), path.at(40.0)


@pytest.mark.parametrize("angle_deg", [0.0, 1e-6, 20.0, 60.0])
@pytest.mark.parametrize(("n", "slopes"), [(1.333, (0.0, 0.0)), (1.333, (0.1, -0.2)), (1.0, (0.0, 0.0))])
def test_trace_has_the_gradient_of_its_differences_in_everything(angle_deg, n, slopes):
    angle = math.radians(angle_deg)
    ray = leaf([math.sin(angle), 0.0, -math.cos(angle)])
    index = n if n == 1.0 else leaf(n)
    leaves = (leaf([1.0, 2.0, 30.0]), ray, leaf(0.0), index, leaf(slopes[0]), leaf(slopes[1]))
    # Steps make the ray longer or shorter than one, of which `air_length` and `at` know nothing.
    assert torch.autograd.gradcheck(traced, leaves, **{**DIFFERENCES, "atol": 1e-5})


def gradients(rays, points, camera, dtype):
    """Gradients of everything that `trace` and `project` say, with respect to everything that they are given."""
    leaves = [leaf(v, dtype) for v in (rays, points, camera, 0.0, 1.333, 0.01, -0.02)]
    ray, point, centre, z, n, slope_x, slope_y = leaves
    water = FlatWater((0.0, 0.0, z), n_water=n, slope_x=slope_x, slope_y=slope_y)
    path, found = trace(centre, ray, water), project(point, centre, water)
    told = [path.crossing, path.air_length, path.water_direction, path.at_height(-2.0, water)]
    told += [found.direction, found.crossing, found.air_length, found.water_length, found.depth]
    sum(v[torch.isfinite(v)].sum() for v in told).backward()
    return [v.grad.numpy() for v in leaves]


def test_float32_has_the_gradients_of_float64(rng):
    rays = rng.normal(size=(20, 3)) - [0.0, 0.0, 3.0]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    given = rays, rng.uniform([-20, -20, -9], [20, 20, 3], (20, 3)), np.array([1.0, 2.0, 30.0])
    for found, exact in zip(gradients(*given, torch.float32), gradients(*given, torch.float64), strict=True):
        # Sums over forty rays of derivatives of up to 50, some of which cancel.
        np.testing.assert_allclose(found, exact, rtol=2e-5, atol=2e-3)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_near_the_critical_angle_the_gradient_is_zero(dtype):
    # Within cos^2 = sqrt(eps) of leaving along the surface, half of the digits of the derivative are gone.
    limit = torch.finfo(dtype).eps ** 0.25
    cosines = torch.tensor([4.0, 1.1, 0.9, 0.1], dtype=torch.float64) * limit
    sines = torch.sqrt(1.0 - cosines**2) / 1.34
    rays = torch.stack([sines, 0.0 * sines, torch.sqrt(1.0 - sines**2)], -1).to(dtype).requires_grad_()
    down = torch.tensor([0.0, 0.0, -1.0], dtype=dtype)
    bent = bend(rays, down, n_from=1.34, n_to=1.0)
    assert torch.isfinite(bent).all()
    bent.sum().backward()
    assert (rays.grad[2:] == 0.0).all()
    assert (rays.grad[:2, 2].abs() > 0.2 / limit).tolist() == [True, True]


@pytest.mark.parametrize(("n_from", "n_to"), [(1.0, 1.34), (1.34, 1.0), (1.0, 1.0)])
def test_rays_along_the_surface_are_nan_without_gradient(n_from, n_to):
    rays, up = leaf([[1.0, 0.0, 0.0], [0.6, 0.0, -0.8]]), leaf([0.0, 0.0, 1.0])
    bent = bend(rays, up, n_from=n_from, n_to=n_to)
    assert torch.isnan(bent).all(dim=-1).tolist() == [True, False]
    bent.nansum().backward()
    assert (rays.grad[0] == 0.0).all()
    assert torch.isfinite(up.grad).all()


# Of the largest derivative of a kind. Measured worst: 1.2e-14, and 2e-12 under 1 cm of water, which costs two digits.
FIRST, SECOND = 2.4e-14, 4e-12
# Camera, point, level, index and slopes.
CASES = {
    "oblique": [1.0, 2.0, 30.0, 8.0, 3.0, -3.0, 0.2, 1.333, 0.02, -0.01],
    "nadir": [1.0, 2.0, 30.0, 1.0, 2.0, -3.0, 0.2, 1.333, 0.0, 0.0],
    "shallow": [1.0, 2.0, 30.0, 8.0, 3.0, 0.19, 0.2, 1.333, 0.0, 0.0],
    "far": [1.0, 2.0, 30.0, 300.0, 3.0, -3.0, 0.2, 1.333, 0.004, 0.001],
    "deep and tilted": [1.0, 2.0, 30.0, 13.0, -5.0, -400.0, 0.2, 1.6, -0.3, 0.2],
    "index one": [1.0, 2.0, 30.0, 8.0, 3.0, -3.0, 0.2, 1.0, 0.02, -0.01],
}


def seen_at(numbers):
    """Direction, crossing, lengths and depth from the ten numbers of a case."""
    water = FlatWater((0.3, -0.2, numbers[6]), n_water=numbers[7], slope_x=numbers[8], slope_y=numbers[9])
    found = project(numbers[3:6], numbers[:3], water)
    lengths = torch.stack([found.air_length, found.water_length, found.depth])
    return torch.cat([found.direction, found.crossing, lengths])


def seen_exactly(numbers):
    """`seen_at` in mpmath, with the share of the way that lies in air found by Newton's steps in all digits."""
    camera, point = mpmath.matrix(numbers[:3]), mpmath.matrix(numbers[3:6])
    z, n, slope_x, slope_y = numbers[6:]
    at, up = mpmath.matrix([mpmath.mpf(0.3), mpmath.mpf(-0.2), z]), mpmath.matrix([-slope_x, -slope_y, 1])
    up = up / mpmath.norm(up)
    H, h = ((camera - at).T * up)[0], -((point - at).T * up)[0]
    way = point - camera + (H + h) * up
    square = (way.T * way)[0]
    share = mpmath.findroot(
        lambda u: u + h * u / mpmath.sqrt((n * H) ** 2 + (n * n - 1) * square * u * u) - 1, H / (H + h / n)
    )
    air, water = share * way - H * up, (1 - share) * way - h * up
    return [*(air / mpmath.norm(air)), *(camera + air), mpmath.norm(air), mpmath.norm(water), h]


@pytest.mark.parametrize("name", CASES)
def test_derivatives_of_both_modes_are_those_of_fifty_digits(name):
    numbers = torch.tensor(CASES[name], dtype=torch.float64)
    first, second = exact_derivatives(seen_exactly, CASES[name])
    assert worst(jacrev(seen_at)(numbers), first) < FIRST
    assert worst(jacfwd(seen_at)(numbers), first) < FIRST
    assert worst(hessian(seen_at)(numbers), second) < SECOND
    assert worst(jacrev(jacrev(seen_at))(numbers), second) < SECOND


def traced_at(numbers):
    water = FlatWater((0.3, -0.2, numbers[6]), n_water=numbers[7], slope_x=numbers[8], slope_y=numbers[9])
    ray = numbers[3:6] - numbers[:3]
    path = trace(numbers[:3], ray / ray.norm(), water)
    return torch.cat([path.crossing, path.water_direction, path.air_length[None], path.at_height(-2.0, water)])


def test_trace_has_the_same_derivatives_in_both_modes():
    for numbers in CASES.values():
        numbers = torch.tensor(numbers, dtype=torch.float64)
        forward, reverse = jacfwd(traced_at)(numbers), jacrev(traced_at)(numbers)
        np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(jacfwd(jacrev(traced_at))(numbers), jacrev(jacfwd(traced_at))(numbers), atol=1e-9)


@pytest.mark.parametrize("function", [seen_at, traced_at])
def test_vmap_over_all_numbers_is_the_loop_over_them(function):
    numbers = torch.tensor(list(CASES.values()), dtype=torch.float64)
    each = torch.stack([function(row) for row in numbers])
    np.testing.assert_allclose(vmap(function)(numbers), each, rtol=1e-13, atol=1e-13)
    tangents = torch.ones_like(numbers)
    outside, inside = jvp(vmap(function), (numbers,), (tangents,)), vmap(lambda x, t: jvp(function, (x,), (t,)))
    np.testing.assert_allclose(outside[1], inside(numbers, tangents)[1], rtol=1e-11, atol=1e-12)


EPS32 = np.finfo(np.float32).eps
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
