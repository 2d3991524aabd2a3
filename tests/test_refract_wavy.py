"""Waves: the first meeting of a ray is never skipped, still waves are a plane, gradients flow to every wave."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from surface_rays import bed_points, cameras, falling_rays, view_angle

from refract import kernels
from refract.curved.wavy import WavyWater
from refract.surfaces import FlatWater

EPS32 = np.finfo(np.float32).eps
POINT = (1.0, 2.0, 0.5)


def sea(amplitudes, wavelengths, headings, **more) -> WavyWater:
    """Waves by wavelength [m] and heading [rad from x], with phases 0.3, 1.3, 2.3, ... rad."""
    vectors = [
        (2.0 * math.pi / length * math.cos(a), 2.0 * math.pi / length * math.sin(a))
        for length, a in zip(wavelengths, headings, strict=True)
    ]
    return WavyWater(POINT, amplitudes, vectors, [0.3 + i for i in range(len(vectors))], **more)


CALM = sea((0.02, 0.01), (4.0, 2.5), (0.3, 1.7), slope_x=0.001)
ROUGH = sea((0.06, 0.03, 0.01), (2.0, 1.1, 0.4), (0.3, 1.7, -0.4), slope_y=0.002)


def test_still_waves_are_a_plane(rng):
    tilt = {"n_water": 1.34, "slope_x": 0.01, "slope_y": -0.02}
    flat, still = FlatWater(POINT, **tilt), sea((0.0, 0.0), (3.0, 0.2), (0.0, 1.0), **tilt)
    camera = cameras(rng, 1000)
    bed = rng.uniform(-30, 30, 1000), rng.uniform(-30, 30, 1000), rng.uniform(-10, 3, 1000)
    expected, _, _ = flat.crossing(camera, bed, 4)
    found, depth, count = still.crossing(camera, bed, 4)
    np.testing.assert_allclose(found, expected, atol=1e-12)  # coordinates of 30 m, some 100 roundings
    np.testing.assert_allclose(depth, flat.height(*bed[:2]) - bed[2], atol=1e-14)
    assert np.all(count == 1)
    ray = falling_rays(rng, 1000, flattest_deg=95.0)
    np.testing.assert_allclose(still.intersect(camera, ray), flat.intersect(camera, ray), rtol=1e-12)


@pytest.mark.parametrize("flattest_deg", [60.0, 89.9])
def test_the_first_meeting_is_never_skipped(rng, flattest_deg):
    """Against a walk along the ray in 20 000 steps, a small part of a wave each, from the highest crest down."""
    camera, ray = cameras(rng, 60, (0.7, 3.0)), falling_rays(rng, 60, flattest_deg - 20.0, flattest_deg)
    found = ROUGH.intersect(camera, ray)
    x, y, z = kernels.point_at_distance(camera, ray, found)
    np.testing.assert_allclose(z, ROUGH.height(x, y), atol=1e-12)
    crest = POINT[2] + sum(ROUGH.amplitudes) + 0.002 * 40.0
    start = np.maximum((camera[2] - crest) / -ray[2], 0.0)
    t = start + (found - start) * np.linspace(0.0, 1.0, 20_000, endpoint=False)[:, None]
    x, y, z = kernels.point_at_distance(camera, ray, t)
    assert np.all(z > ROUGH.height(x, y))


def test_rays_that_rise_meet_a_crest_or_nothing():
    """From a trough, level rays end in the next crest, steeper ones pass it, as plain geometry says."""
    swell = WavyWater((0.0, 0.0, 0.0), (1.0,), ((1.0, 0.0),))
    camera = np.full(3, -0.5 * math.pi), np.zeros(3), np.full(3, 0.0)  # 1 m over the trough
    rise = np.array([0.0, 0.2, 0.6])
    ray = np.cos(rise), np.zeros(3), np.sin(rise)
    found = swell.intersect(camera, ray)
    np.testing.assert_allclose(found[0], 0.5 * math.pi, rtol=1e-14)  # z = 0 is met again at x = 0
    np.testing.assert_array_equal(np.isfinite(found), [True, True, False])
    above = swell.intersect((np.zeros(1), np.zeros(1), np.full(1, 1.5)), (np.ones(1), np.zeros(1), np.zeros(1)))
    assert np.isnan(above[0])


@pytest.mark.parametrize("water", [CALM, ROUGH], ids=["calm", "rough"])
def test_the_normal_is_that_of_the_height(rng, water):
    x, y = rng.uniform(-20.0, 20.0, (2, 100))
    nx, ny, nz = water.normal(x, y)
    step = 1e-5
    slope_x = (water.height(x + step, y) - water.height(x - step, y)) / (2.0 * step)
    slope_y = (water.height(x, y + step) - water.height(x, y - step)) / (2.0 * step)
    np.testing.assert_allclose([-nx / nz, -ny / nz], [slope_x, slope_y], atol=1e-8)  # k^3 a step^2 / 6
    np.testing.assert_allclose(nx**2 + ny**2 + nz**2, 1.0, rtol=1e-15)


def test_far_ripples_keep_their_phase_in_float32():
    x = torch.full((1,), 1000.0)
    ripple = WavyWater((0.0, 0.0, 0.0), (0.01,), ((15.0, 0.0),))
    expected = ripple.normal(np.array([1000.0]), np.zeros(1))
    found = ripple.normal(x, 0.0 * x)
    assert found[0].dtype == torch.float32
    np.testing.assert_allclose([float(c) for c in found], np.ravel(expected), atol=EPS32)


def test_bounds_hold(rng):
    x, y = rng.uniform(-30.0, 30.0, (2, 5000))
    z, zx, zy, zxx, zxy, zyy = ROUGH.derivatives(x, y)
    bounds = ROUGH.bounds(np.zeros(1), np.zeros(1), np.full(1, 43.0))
    assert np.all((z >= bounds.z_lo) & (z <= bounds.z_hi))
    assert np.hypot(zx, zy).max() <= bounds.slope
    assert np.abs(np.linalg.eigvalsh(np.stack([[zxx, zxy], [zxy, zyy]]).transpose(2, 0, 1))).max() <= bounds.curvature


def test_project_returns_the_traced_ray(rng):
    camera, ray = cameras(rng, 2000), falling_rays(rng, 2000, flattest_deg=70.0)
    bed = bed_points(CALM, camera, ray, rng.uniform(0.01, 6.0, 2000))
    crossing, _, count = CALM.crossing(camera, bed, 4)
    assert np.all(count == 1)
    assert view_angle(camera, crossing, ray).max() < 1e-12  # measured 2e-15


def test_waves_move_with_their_frequency(rng):
    moving = WavyWater(POINT, (0.1,), ((2.0, 0.0),), frequencies=(3.0,))
    x, y = rng.uniform(-3.0, 3.0, (2, 20))
    np.testing.assert_allclose(moving.at(0.4).height(x + 0.6, y), moving.height(x, y), atol=1e-15)


LEAVES = {
    "level": 0.5, "amplitude": 0.05, "kx": 1.9, "ky": -0.7, "phase": 0.4, "n": 1.333, "slope": 0.01,
}  # fmt: skip


def wave_of(level, amplitude, kx, ky, phase, n, slope):
    vectors = ((kx, ky), (0.3, 2.0))
    return WavyWater((1.0, 2.0, level), (amplitude, 0.02), vectors, (phase, 0.1), n_water=n, slope_x=slope)


def leaves(*values):
    return [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in values]


@pytest.mark.parametrize("offset", [0.0, 11.0])
def test_crossings_have_the_right_gradient_in_ends_and_waves(offset):
    def crossing(cx, cy, cz, px, py, pz, *wave):
        return torch.stack(wave_of(*wave).crossing((cx, cy, cz), (px, py, pz), 4)[0])

    ends = leaves(1.0, 2.0, 30.0, 1.0 + offset, 2.0, -3.0)
    assert torch.autograd.gradcheck(crossing, (*ends, *leaves(*LEAVES.values())), eps=1e-6, atol=1e-6)


def test_first_meetings_have_the_right_gradient_in_rays_and_waves():
    def distance(ox, oy, oz, slant, *wave):
        ray = slant, slant * 0.3, -torch.sqrt(1.0 - 1.09 * slant * slant)
        return wave_of(*wave).intersect((ox, oy, oz), ray)

    rays = leaves(1.0, 2.0, 30.0, 0.6)
    assert torch.autograd.gradcheck(distance, (*rays, *leaves(*LEAVES.values())), eps=1e-6, atol=1e-6)


def test_amplitudes_may_be_one_tensor(rng):
    amplitudes = torch.tensor([0.02, 0.01], dtype=torch.float64, requires_grad=True)
    water = WavyWater(POINT, amplitudes, ((1.0, 2.0), (3.0, -1.0)))
    water.height(torch.ones(3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)).sum().backward()
    assert torch.isfinite(amplitudes.grad).all()


def test_rays_and_points_without_answer_are_nan_and_their_gradients_zero():
    camera = tuple(torch.tensor([c] * 3, dtype=torch.float64, requires_grad=True) for c in (1.0, 2.0, 30.0))
    ray = tuple(torch.tensor(c, dtype=torch.float64) for c in ([0.6, 0.6, 0.0], [0.0] * 3, [0.8, -0.8, -1.0]))
    level = torch.tensor(0.5, dtype=torch.float64, requires_grad=True)
    water = WavyWater((0.0, 0.0, level), (0.05,), ((2.0, 0.0),))
    t = water.intersect(camera, ray)
    np.testing.assert_array_equal(torch.isfinite(t).numpy(), [False, True, True])
    t[1:].sum().backward()
    assert torch.isfinite(level.grad)
    assert all(torch.isfinite(c.grad).all() for c in camera)
    assert camera[2].grad[0] == 0.0


def test_dry_points_and_drowned_cameras_see_straight():
    water = WavyWater((0.0, 0.0, 0.0), (0.05,), ((2.0, 0.0),))
    camera = np.zeros(3), np.zeros(3), np.array([10.0, 10.0, -1.0])
    point = np.full(3, 2.0), np.zeros(3), np.array([1.0, np.nan, -3.0])
    found, _, count = water.crossing(camera, point, 4)
    np.testing.assert_array_equal(np.stack(found, -1)[[0, 2]], np.stack(point, -1)[[0, 2]])
    assert np.isnan(found).all(axis=0)[1]
    np.testing.assert_array_equal(count, 1)


def test_torch_agrees_with_numpy_in_both_precisions(rng):
    camera, ray = cameras(rng, 300), falling_rays(rng, 300)
    bed = bed_points(CALM, camera, ray, rng.uniform(0.01, 6.0, 300))
    for dtype, tolerance in ((torch.float64, 1e-12), (torch.float32, 8 * EPS32)):
        ends = (tuple(torch.tensor(c, dtype=dtype) for c in end) for end in (camera, bed))
        found, depth, count = CALM.crossing(*ends, 4)
        assert found[0].dtype == depth.dtype == torch.float64  # `project` rounds it
        assert torch.all(count == 1)
        # In float32 the ends themselves are rounded: 30 m by 2e-6, seen from 5 m and more.
        assert view_angle(camera, tuple(c.double().numpy() for c in found), ray).max() < tolerance


@pytest.mark.slow
def test_drjit_agrees_with_numpy(rng):
    drjit = pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM; install libllvm19 or set DRJIT_LIBLLVM_PATH")
    from drjit.llvm.ad import Float64

    camera, ray = cameras(rng, 200), falling_rays(rng, 200, flattest_deg=80.0)
    wrapped = tuple(map(Float64, camera)), tuple(map(Float64, ray))
    np.testing.assert_allclose(np.asarray(ROUGH.intersect(*wrapped)), ROUGH.intersect(camera, ray), rtol=1e-12)
    ray = falling_rays(rng, 200)
    bed = bed_points(CALM, camera, ray, rng.uniform(0.01, 2.0, 200))
    leaf = tuple(map(Float64, bed))
    drjit.enable_grad(*leaf)
    found, _, count = CALM.crossing(wrapped[0], leaf, 4)
    np.testing.assert_array_equal(np.asarray(count), 1)
    assert view_angle(camera, tuple(np.asarray(c) for c in found), ray).max() < 1e-12
    drjit.backward(found[0] + 2.0 * found[1])
    twin = tuple(torch.tensor(c, requires_grad=True) for c in bed)
    at, _, _ = CALM.crossing(tuple(map(torch.tensor, camera)), twin, 4)
    (at[0] + 2.0 * at[1]).sum().backward()
    for own, other in zip(leaf, twin, strict=True):
        np.testing.assert_allclose(np.asarray(drjit.grad(own)), other.grad.numpy(), atol=1e-10)


@pytest.mark.slow
def test_drjit_gradients_of_waves_agree_with_torch(rng):
    drjit = pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM; install libllvm19 or set DRJIT_LIBLLVM_PATH")
    from drjit.llvm.ad import Float64

    camera, ray = cameras(rng, 50), falling_rays(rng, 50, flattest_deg=40.0)
    bed = bed_points(CALM, camera, ray, rng.uniform(0.5, 2.0, 50))
    gradients = []
    for wrap, number in ((Float64, Float64), (torch.tensor, lambda v: torch.tensor(v, dtype=torch.float64))):
        own = [number(v) for v in LEAVES.values()]
        if wrap is Float64:
            drjit.enable_grad(*own)
        else:
            own = [v.requires_grad_() for v in own]
        ends, rays, points = (tuple(map(wrap, v)) for v in (camera, ray, bed))
        water = wave_of(*own)
        crossing, _, count = water.crossing(ends, points, 4)
        assert np.all(np.asarray(count) == 1)
        total = sum(crossing) + water.intersect(ends, rays)
        if wrap is Float64:
            drjit.backward(total)
            gradients.append([np.asarray(drjit.grad(v)).item() for v in own])
        else:
            total.sum().backward()
            gradients.append([v.grad.item() for v in own])
    np.testing.assert_allclose(*gradients, rtol=1e-10)  # sums of 50 derivatives, some of which cancel


def test_wrong_numbers_are_named():
    with pytest.raises(ValueError, match=r"2 amplitudes|\(2, 1, 2, 2\)"):
        WavyWater(POINT, (0.1, 0.2), ((1.0, 0.0),))
    with pytest.raises(ValueError, match="finite"):
        WavyWater(POINT, (math.nan,), ((1.0, 0.0),))
    with pytest.raises(ValueError, match=r"2\.5"):
        WavyWater(POINT, (0.1,), ((1.0, 0.0),), n_water=2.5)
