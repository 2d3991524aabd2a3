"""Water with the curvature of the Earth: against exact arithmetic, and against the plane it tends to."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
import torch
from surface_rays import bed_points, cameras, falling_rays, view_angle

from refract.curved.spherical import MEAN_RADIUS_M, SphericalWater, curvature_drop, gaussian_radius
from refract.surfaces import FlatWater

RAY_RAD = 1e-12  # project after trace; measured 1e-14 over 1 km
LEVEL = (3.0, -2.0, 0.5)


def exact_distance(water, origin, ray):
    """Distance to the sphere in 60 digits, by the textbook quadratic."""
    with mpmath.workdps(60):
        centre = [mpmath.mpf(water.point[0]), mpmath.mpf(water.point[1]), mpmath.mpf(water.point[2]) - water.radius]
        o = [mpmath.mpf(float(a)) - c for a, c in zip(origin, centre, strict=True)]
        d = [mpmath.mpf(float(a)) for a in ray]
        a, b = mpmath.fdot(d, d), mpmath.fdot(o, d)
        c = mpmath.fdot(o, o) - mpmath.mpf(water.radius) ** 2
        room = b * b - a * c
        return float((-b - mpmath.sqrt(room)) / a) if room > 0 else math.nan


@pytest.mark.parametrize("radius", [1e3, MEAN_RADIUS_M, 1e12])
def test_rays_meet_the_sphere_where_exact_arithmetic_says(rng, radius):
    water = SphericalWater(LEVEL, radius)
    origin, ray = cameras(rng, 50, (5.0, 200.0), spread=100.0), falling_rays(rng, 50, flattest_deg=80.0)
    found = water.intersect(origin, ray)
    assert np.isfinite(found).sum() > 40
    expected = [exact_distance(water, o, r) for o, r in zip(np.stack(origin, -1), np.stack(ray, -1), strict=True)]
    # A handful of roundings, and those of the ray's length, magnified by R / H where the ray is unit to one rounding.
    np.testing.assert_allclose(found, expected, rtol=1e-14)


def test_a_camera_on_the_sphere_touches_at_once_and_a_rising_ray_never():
    water = SphericalWater((0.0, 0.0, 0.0))
    zero = np.zeros(3)
    found = water.intersect((zero, zero, np.array([0.0, 10.0, 10.0])), (zero, zero + 0.0, np.array([-1.0, 1.0, -1.0])))
    np.testing.assert_array_equal(found, [0.0, np.nan, 10.0])


def test_beyond_the_horizon_a_flat_ray_misses_the_earth():
    water, height = SphericalWater((0.0, 0.0, 0.0)), 100.0
    dip = math.acos(MEAN_RADIUS_M / (MEAN_RADIUS_M + height))
    angles = dip * np.array([0.999, 1.001])
    ray = np.cos(angles), np.zeros(2), -np.sin(angles)
    found = water.intersect((np.zeros(2), np.zeros(2), np.full(2, height)), ray)
    np.testing.assert_array_equal(np.isfinite(found), [False, True])


def test_a_huge_sphere_tends_to_the_plane(rng):
    camera, ray = cameras(rng, 300, spread=500.0), falling_rays(rng, 300)
    flat = FlatWater((0.0, 0.0, 0.5))
    bed = bed_points(flat, camera, ray, rng.uniform(0.1, 20.0, 300))
    errors = []
    for radius in (1e8, 1e9, 1e10):
        water = SphericalWater((0.0, 0.0, 0.5), radius)
        crossing, _, count = water.crossing(camera, bed, 4)
        assert np.all(count == 1)
        errors.append(view_angle(camera, crossing, ray).max())
    np.testing.assert_allclose(np.divide(errors[:-1], errors[1:]), 10.0, rtol=1e-3)  # first order in 1 / R


def test_project_returns_the_traced_ray(rng):
    water = SphericalWater(LEVEL)
    camera, ray = cameras(rng, 2000, (1.0, 1000.0), spread=1000.0), falling_rays(rng, 2000, flattest_deg=80.0)
    depth = rng.uniform(0.01, 50.0, 2000)
    bed = bed_points(water, camera, ray, depth)
    crossing, found, count = water.crossing(camera, bed, 4)
    assert np.all(count == 1)
    assert view_angle(camera, crossing, ray).max() < RAY_RAD
    twin, _, _ = water.crossing(tuple(map(torch.tensor, camera)), tuple(map(torch.tensor, bed)), 4)
    assert view_angle(camera, tuple(c.numpy() for c in twin), ray).max() < RAY_RAD
    assert np.abs(found - depth).max() < 0.5  # the surface rises or falls by centimetres between crossing and point


def test_the_normal_is_that_of_the_height(rng):
    water, (x, y) = SphericalWater(LEVEL, 1e3), rng.uniform(-200.0, 200.0, (2, 50))
    _, zx, zy, *_ = water.derivatives(x, y)
    nx, ny, nz = water.normal(x, y)
    np.testing.assert_allclose([-nx / nz, -ny / nz], [zx, zy], rtol=1e-13)
    np.testing.assert_allclose(water.height(x + 1e-3, y) - water.height(x - 1e-3, y), 2e-3 * zx, atol=1e-9)


def test_the_drop_is_two_centimetres_at_500_m():
    assert abs(curvature_drop(500.0) - 0.0196) < 5e-5
    with mpmath.workdps(40):
        exact = MEAN_RADIUS_M - mpmath.sqrt(mpmath.mpf(MEAN_RADIUS_M) ** 2 - 1000**2)
        assert abs(curvature_drop(1000.0) / exact - 1) < 4e-16
    assert math.isnan(curvature_drop(2.0 * MEAN_RADIUS_M))


def test_the_gaussian_radius_lies_between_those_of_equator_and_pole():
    # WGS 84: b at the equator (sqrt(M N) = b), a^2 / b at the poles.
    np.testing.assert_allclose(gaussian_radius(0.0), 6_356_752.314245, rtol=1e-12)
    np.testing.assert_allclose(gaussian_radius(math.pi / 2.0), 6_399_593.625758, rtol=1e-12)


def test_gradients_flow_to_rays_level_radius_and_index():
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (1.0, 2.0, 40.0, 12.0, -3.0, -4.0)]
    own = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.5, 900.0, 1.333)]

    def crossing(cx, cy, cz, px, py, pz, level, radius, n):
        water = SphericalWater((0.0, 0.0, level), radius, n_water=n)
        return torch.stack(water.crossing((cx, cy, cz), (px, py, pz), 4)[0])

    def distance(dx, level, radius):
        water = SphericalWater((0.0, 0.0, level), radius)
        ray = dx, dx * 0.0, -torch.sqrt(1.0 - dx * dx)
        return water.intersect(tuple(dx * 0.0 + c for c in (1.0, 2.0, 30.0)), ray)

    assert torch.autograd.gradcheck(crossing, (*leaves, *own), eps=1e-5, atol=1e-6)
    dx = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(distance, (dx, *own[:2]), eps=1e-5, atol=1e-6)


def test_gradients_where_the_sphere_touches_are_finite():
    x = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    water = SphericalWater((0.0, 0.0, 0.0))
    (water.height(x, x) + sum(water.normal(x, x))).sum().backward()
    assert torch.isfinite(x.grad).all()


def test_wrong_numbers_are_named():
    with pytest.raises(ValueError, match="positive radius"):
        SphericalWater((0.0, 0.0, 0.0), -1.0)
    with pytest.raises(ValueError, match=r"0\.9"):
        SphericalWater((0.0, 0.0, 0.0), n_water=0.9)
