"""Digits and gradients at the edge: lengths that are not one, legs of no length, coordinates far from the origin."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from refract import FlatWater, bend, project, trace

WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
CENTRE = np.array([0.0, 0.0, 30.0])
RAY = np.array([0.6, 0.0, -0.8])


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0 - 1e-4, 1.0 + 1e-4, 2.0, 1e200])
@pytest.mark.parametrize("water", [WATER, None])
def test_a_direction_whose_length_is_not_one_is_invalid(factor, water):
    path = trace(CENTRE, np.stack([RAY, factor * RAY]), water)
    np.testing.assert_array_equal(np.isnan(path.air_length), [False, True])
    assert np.isnan(path.water_direction[1]).all()
    assert np.isnan(path.crossing[1]).all()
    assert np.isnan(path.at(3.0)[1]).all()
    assert np.isnan(path.at_height(1.0, water)[1]).all()


def test_the_rounding_of_a_direction_is_not_its_length():
    ray = RAY.astype(np.float32)[None] * np.float32(1.0 + 3e-7)
    assert trace(torch.tensor(CENTRE).float(), torch.tensor(ray), WATER).wet.all()
    assert trace(CENTRE, RAY * (1.0 + 4e-6), WATER).wet


def test_bend_refuses_rays_and_normals_whose_length_is_not_one():
    rays, normals = np.stack([RAY, 2.0 * RAY, RAY]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 3.0]])
    bent = bend(rays, normals, n_from=1.0, n_to=1.333)
    np.testing.assert_array_equal(np.isnan(bent).all(axis=-1), [False, True, True])


@pytest.mark.parametrize(("n_from", "n_to"), [(1.0, 0.0), (0.0, 1.0), (1.0, -1.3), (math.nan, 1.0), (1.0, math.inf)])
def test_indices_that_are_not_positive_and_finite_are_named(n_from, n_to):
    with pytest.raises(ValueError, match="finite refractive indices above zero"):
        bend(RAY, np.array([0.0, 0.0, 1.0]), n_from=n_from, n_to=n_to)


TINY = [10.0**power for power in range(-44, 0)] + [0.0, 5e-324, 1e-300, 1e-154, 1e-102]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("where", ["depth", "height", "aside"])
def test_no_tiny_length_makes_the_gradient_of_a_shared_camera_nan(dtype, where):
    for tiny in TINY:
        point, centre = [5.0, 1.0, -3.0], [0.0, 0.0, 30.0]
        if where == "depth":
            point[2] = -tiny
        elif where == "height":
            centre[2] = tiny
        else:
            point[0], point[1] = tiny, 0.0
        points = torch.tensor([[1.0, 2.0, -3.0], point], dtype=dtype)
        camera, level = (torch.tensor(v, dtype=dtype, requires_grad=True) for v in (centre, 0.0))
        seen = project(points, camera, FlatWater((0.0, 0.0, level), n_water=1.333))
        told = (seen.direction, seen.crossing, seen.air_length, seen.water_length, seen.depth)
        sum(v[torch.isfinite(v)].sum() for v in told).backward()
        assert torch.isfinite(camera.grad).all(), tiny
        assert torch.isfinite(level.grad), tiny


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.1, -0.02)])
def test_directions_keep_their_digits_far_from_the_origin(rng, slopes):
    """Whole metres: adding them to coordinates of 2^-20 m costs no rounding, so nothing may change."""
    away = np.array([5e6, -3e6, 100.0])
    points = np.round(rng.uniform([-30, -30, -9], [30, 30, -4], (500, 3)) * 2.0**20) / 2.0**20
    here, there = (
        FlatWater(tuple(place), n_water=1.333, slope_x=slopes[0], slope_y=slopes[1]) for place in (0 * away, away)
    )
    near, far = project(points, CENTRE, here), project(points + away, CENTRE + away, there)
    for name in ("direction", "air_length", "water_length", "depth"):
        np.testing.assert_array_equal(getattr(far, name), getattr(near, name))


def test_float32_has_the_camera_gradients_of_float64_close_over_deep_water():
    """2 mm over the water and 610 m of it, where absolute coordinates cost 3 % of the gradient."""
    points = torch.tensor([[300.0, 120.0, -610.0]], dtype=torch.float64)
    found = []
    for dtype in (torch.float32, torch.float64):
        camera = torch.tensor([0.0, 0.0, 2e-3], dtype=torch.float32).to(dtype).requires_grad_()
        project(points.to(dtype), camera, WATER).direction.sum().backward()
        found.append(camera.grad.double().numpy())
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)  # sums of three derivatives, each rounded once


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.02, -0.01), (0.2, 0.1)])
@pytest.mark.parametrize("away", [0.0, 5000.0])
def test_float32_traces_as_float64_and_rounds_at_the_end(rng, slopes, away):
    """Also where the point of a tilted plane lies far away; three roundings for the direction, one for the rest."""
    level = away * (slopes[0] - slopes[1])
    water = FlatWater((away, -away, level), n_water=1.34, slope_x=slopes[0], slope_y=slopes[1])
    rays = rng.normal(size=(2000, 3)) * [0.3, 0.3, 0.0] - [0.0, 0.0, 1.0]
    rays = torch.tensor(rays / np.linalg.norm(rays, axis=-1, keepdims=True), dtype=torch.float32)
    centre = torch.tensor([1.0, 2.0, 60.0], dtype=torch.float32)
    found, exact = trace(centre, rays, water), trace(centre.double(), rays.double(), water)
    half_unit = 2.0**-24
    assert ((found.crossing - exact.crossing).abs() <= 1.01 * half_unit * exact.crossing.abs() + 1e-12).all()
    assert ((found.air_length - exact.air_length).abs() <= 1.01 * half_unit * exact.air_length).all()
    assert (found.water_direction - exact.water_direction).abs().max() < 4 * half_unit
