"""Derivatives of bent paths: closed forms, differences, fifty digits, and finite where there is nothing to derive."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from fifty_digits import exact_derivatives, worst
from torch.func import hessian, jacfwd, jacrev, jvp, vmap

from refract import FlatWater, bend, project, trace

# A derivative is reached through some twenty roundings; the closed forms cost as many. Measured worst: 6e-13.
RELATIVE = 1e-12
# Central differences with steps of 1e-6 of values of about one: third derivatives and rounding leave 1e-9.
DIFFERENCES = {"eps": 1e-6, "atol": 1e-7, "rtol": 1e-6}


def leaf(value, dtype=torch.float64):
    return torch.tensor(value, dtype=dtype, requires_grad=True)


def geometry(tangent, H, h, n):
    """Distance along the plane at which a ray of this tangent in air ends up in depth ``h``."""
    return H * tangent + h * tangent / np.sqrt(n**2 + (n**2 - 1.0) * tangent**2)


@pytest.mark.parametrize("n", [1.0, 1.1, 1.333, 1.6])
def test_the_direction_of_view_has_its_closed_derivatives_over_the_extremes(rng, n):
    """With ``x = tan a``: ``D = H x + h x q``, ``q^-2 = n^2 + (n^2 - 1) x^2``, so ``dx/dD = 1 / (H + h n^2 q^3)``."""
    count = 2000
    H, h = 10.0 ** rng.uniform(-1, 4, count), 10.0 ** rng.uniform(-4, 2, count)
    x = np.tan(np.radians(rng.uniform(0.0, 75.0, count)))  # a unit vector loses 1 / cos^2 of its digits
    q = 1.0 / np.sqrt(n**2 + (n**2 - 1.0) * x**2)
    stiff = H + h * n**2 * q**3
    points, level, index = leaf(np.stack([geometry(x, H, h, n), 0 * x, -h], -1)), leaf(0.0), leaf(n)
    camera = leaf(np.stack([0 * x, 0 * x, H], -1))
    water = FlatWater((0.0, 0.0, level), n_water=index)
    sine = project(points, camera, water).direction[:, 0]
    slope = (1.0 + x**2) ** -1.5  # of the sine over the tangent

    (of_point, of_camera) = torch.autograd.grad(sine.sum(), [points, camera], retain_graph=True)
    np.testing.assert_allclose(of_point[:, 0], slope / stiff, rtol=RELATIVE)
    np.testing.assert_allclose(of_point[:, 2], slope * x * q / stiff, rtol=RELATIVE)
    np.testing.assert_allclose(of_camera[:, 0], -slope / stiff, rtol=RELATIVE)
    np.testing.assert_allclose(of_camera[:, 2], -slope * x / stiff, rtol=RELATIVE)
    of_index = slope * h * x * n * (1.0 + x**2) * q**3 / stiff
    of_level = slope * x * (1.0 - q) / stiff  # the camera comes nearer, the point deeper
    for each in range(0, count, 100):
        found = torch.autograd.grad(sine[each], [index, level], retain_graph=True)
        assert found[0].item() == pytest.approx(of_index[each], rel=RELATIVE)
        # At index one the water does nothing, and the derivative is what rounding leaves of q - 1.
        assert found[1].item() == pytest.approx(of_level[each], rel=1e-11, abs=1e-15 / H[each])


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


def hard_cases():
    """Rays and points at which derivatives tend to break: (origin, ray) and (camera, point) rows."""
    angles = np.radians([0.0, 1e-4, 45.0, 89.0, 89.9, 90.0, 135.0])
    rays = np.stack([np.sin(angles), 0.0 * angles, -np.cos(angles)], -1)
    rays[5, 2] = 0.0
    rays = np.concatenate([rays, [[np.nan, 0.0, -1.0], [0.0, 0.0, 0.0], [0.0, 0.0, -np.inf]]])
    points = [
        [1.0, 2.0, -3.0], [1.0, 2.0, 0.0], [1.0, 2.0, -1e-30], [5.0, 2.0, 0.0], [5.0, 2.0, -0.0], [5.0, 2.0, 3.0],
        [1e6, 0.0, -1e3], [np.nan, 0.0, -1.0], [1.0, 2.0, 30.0], [1.0, 2.0, 1e-12], [1e-20, 2.0, -1e-20],
    ]  # fmt: skip
    cameras = [[1.0, 2.0, 30.0], [1.0, 2.0, 1e-3], [1.0, 2.0, 1e-12], [1.0, 2.0, 0.0], [1.0, 2.0, -1.0]]
    return rays, np.array(points), np.array(cameras)


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


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_every_gradient_is_finite_whatever_becomes_of_the_rays(dtype):
    rays, points, cameras = hard_cases()
    for camera in cameras:
        for gradient in gradients(rays, points, camera, dtype):
            assert np.isfinite(gradient).all()


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
