"""Curved surfaces through the public doors: `trace` down and `project` back, on every library that they run on."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from refract import Regime, project, trace
from refract.curved.height_field import HeightFieldWater
from refract.curved.spherical import SphericalWater
from refract.curved.wavy import WavyWater
from refract.surfaces import FlatWater

WAVES = WavyWater((0.0, 0.0, 0.3), (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2)), (0.3, 1.0))
NODES = np.linspace(-90.0, 90.0, 46)
RIVER = HeightFieldWater.from_raster(NODES, NODES, 0.3 + 0.002 * NODES - 1e-5 * NODES[:, None] ** 2)
SURFACES = {"waves": WAVES, "sphere": SphericalWater((0.0, 0.0, 0.3)), "river": RIVER}
RAY_RAD = 1e-12
# float32: the bed point, some 60 m from the origin, is rounded by 2e-6 m, seen from 10 m and more; and the ray by 1e-7.
RAY_RAD_32 = 2e-6


def rays(rng, count, flattest_deg=50.0):
    """Camera centres 10 to 60 m up, and unit rays: (count, 3)."""
    angle, turn = np.radians(rng.uniform(0.0, flattest_deg, count)), rng.uniform(0.0, 2.0 * np.pi, count)
    ray = np.stack([np.sin(angle) * np.cos(turn), np.sin(angle) * np.sin(turn), -np.cos(angle)], axis=-1)
    return np.concatenate([rng.uniform(-3, 3, (count, 2)), rng.uniform(10, 60, (count, 1))], axis=-1), ray


def angle_between(a, b):
    cross = np.linalg.norm(np.cross(a, b), axis=-1)
    return cross / np.linalg.norm(a, axis=-1) / np.linalg.norm(b, axis=-1)


@pytest.mark.parametrize("name", SURFACES)
def test_project_after_trace_returns_the_ray(rng, name):
    camera, ray = rays(rng, 500)
    path = trace(camera, ray, SURFACES[name])
    assert path.wet.all()
    bed = path.at(path.air_length + rng.uniform(0.01, 8.0, 500))
    back = project(bed, camera, SURFACES[name])
    one = back.num_paths == 1
    assert one.mean() > 0.95  # a raster has ridges
    assert angle_between(back.direction, ray)[one].max() < RAY_RAD
    assert back.regime_counts()["bent"] == path.regime_counts()["bent"] == 500


@pytest.mark.parametrize("name", SURFACES)
def test_torch_in_float32_returns_the_ray(rng, name):
    camera, ray = (torch.tensor(v, dtype=torch.float32) for v in rays(rng, 300))
    path = trace(camera, ray, SURFACES[name])
    back = project(path.at(path.air_length + 3.0), camera, SURFACES[name])
    one = (back.num_paths == 1).numpy()
    assert one.mean() > 0.95
    assert back.direction.dtype == torch.float32
    assert angle_between(back.direction.double().numpy(), ray.double().numpy())[one].max() < RAY_RAD_32


@pytest.mark.parametrize("name", ["waves", "sphere"])
def test_drjit_in_float32_returns_the_ray(rng, name):
    drjit = pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM; install libllvm19 or set DRJIT_LIBLLVM_PATH")
    from drjit.llvm.ad import Array3f

    camera, ray = rays(rng, 300)
    centre, wrapped = Array3f(camera.T), Array3f(ray.T)
    path = trace(centre, wrapped, SURFACES[name])
    back = project(path.at(path.air_length + 3.0), centre, SURFACES[name])
    assert np.all(np.asarray(back.num_paths) == 1)
    assert angle_between(np.asarray(back.direction, dtype=np.float64).T, np.asarray(wrapped).T).max() < RAY_RAD_32


@pytest.mark.parametrize("name", SURFACES)
def test_what_has_no_answer_is_counted(name):
    up, down = [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]
    camera = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, 10.0], [0.0, 0.0, -1.0], [np.nan, 0.0, 10.0]])
    path = trace(camera, np.array([up, down, down, down]), SURFACES[name])
    np.testing.assert_array_equal(path.regime, [Regime.STRAIGHT, Regime.BENT, Regime.UNDER_WATER, Regime.INVALID])
    np.testing.assert_array_equal(np.isnan(path.crossing[:, 0]), [True, False, False, True])
    points = np.array([[1.0, 1.0, 5.0], [1.0, 1.0, -2.0], [1.0, 1.0, -2.0], [1.0, 1.0, -2.0]])
    back = project(points, camera, SURFACES[name])
    np.testing.assert_array_equal(back.regime, [Regime.STRAIGHT, Regime.BENT, Regime.UNDER_WATER, Regime.INVALID])


@pytest.mark.parametrize("name", SURFACES)
def test_single_rays_have_no_extra_axis(name):
    camera, ray = np.array([0.0, 0.0, 20.0]), np.array([0.6, 0.0, -0.8])
    path = trace(camera, ray, SURFACES[name])
    back = project(path.at(path.air_length + 2.0), camera, SURFACES[name])
    assert back.direction.shape == (3,)
    assert angle_between(back.direction, ray) < RAY_RAD


def test_all_surfaces_agree_where_they_are_the_same_plane(rng):
    flat = FlatWater((0.0, 0.0, 0.3))
    same = (
        WavyWater((0.0, 0.0, 0.3), (0.0,), ((1.0, 0.0),)),
        HeightFieldWater.from_raster(NODES, NODES, np.full((46, 46), 0.3)),
        SphericalWater((0.0, 0.0, 0.3), 1e16),  # over 90 m the sphere falls by 4e-13 m
    )
    camera, ray = rays(rng, 300)
    path = trace(camera, ray, flat)
    bed = path.at(path.air_length + rng.uniform(0.01, 8.0, 300))
    for water in same:
        np.testing.assert_allclose(trace(camera, ray, water).crossing, path.crossing, atol=2e-12)
        np.testing.assert_allclose(project(bed, camera, water).crossing, path.crossing, atol=2e-12)


def random_sea(rng) -> WavyWater:
    """One to three waves of 0.3 to 30 m, slope to 0.3 in all, over water of index 1 to 1.6."""
    number = rng.integers(1, 4)
    k = 2.0 * np.pi / 10.0 ** rng.uniform(-0.5, 1.5, number)
    heading = rng.uniform(0.0, 2.0 * np.pi, number)
    vectors = np.stack([k * np.cos(heading), k * np.sin(heading)], axis=-1)
    amplitudes = rng.uniform(0.0, 0.3) / number / k
    index = rng.choice([1.0, 1.0001, 1.333, 1.6])
    return WavyWater((0.0, 0.0, 0.0), amplitudes, vectors, rng.uniform(0.0, 6.0, number), n_water=index)


@pytest.mark.slow
def test_random_seas_give_the_ray_back_or_say_that_they_cannot(rng):
    num_paths = []
    for _ in range(60):
        water = random_sea(rng)
        camera, ray = rays(rng, 40, rng.choice([30.0, 70.0, 89.0]))
        camera[:, 2] = sum(water.amplitudes) + 10.0 ** rng.uniform(-3, 3, 40)
        path = trace(camera, ray, water)
        back = project(path.at(path.air_length + 10.0 ** rng.uniform(-3, 1.5, 40)), camera, water)
        one = (back.num_paths == 1) & back.wet & path.wet
        assert angle_between(back.direction, ray)[one].max(initial=0.0) < RAY_RAD
        np.testing.assert_array_equal(np.isnan(back.direction[:, 0]), back.num_paths < 1)
        num_paths.append(back.num_paths)
    assert (np.concatenate(num_paths) == -1).mean() < 0.02
