"""There and back: the ray that was traced, the point projected, over all geometries, libraries and precisions."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from surface_rays import DOUBLE, LIBRARIES, array_of, as_double

from refract import FlatWater, kernels, project, trace
from refract.surfaces import ENOUGH_STEPS_DOUBLE, ENOUGH_STEPS_SINGLE

EPS = np.finfo(np.float64).eps
EPS32 = np.finfo(np.float32).eps
INDICES = (1.0, 1.0001, 1.1, 1.2, 1.333, 1.39, 1.6)
# Measured worst: 1.6e-14 (index 1.0001, 1 mm over 1 km of water, 89.9 deg).
DOUBLE_RAD = 1e-12
# The point in float32 is a rounding away from the ray: half a unit of a coordinate of 1024 m and more is 6.1e-5 m,
# and from 1 mm over 1 km of water at 89.4 deg the ray turns by 1 rad per 31 m, so 1.97e-6. Found by search: 1.96e-6.
SINGLE_RAD = 2e-6
# What is left without that: rounding of the direction itself.
SOLVER_RAD = 2 * EPS32


def geometry():
    """Heights, depths, incidences and azimuths, (K,) each: logarithmic over all of the range, corners included."""
    H = np.geomspace(1e-3, 1e4, 12)
    h = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 10)])
    from_grazing = 90.0 - np.geomspace(0.1, 20.0, 25)
    angle = np.radians(np.concatenate([[0.0, 1e-6, 1e-3], np.linspace(1.0, 75.0, 12), from_grazing]))
    azimuth = np.array([0.0, 0.45, 0.8, 1.2])
    return tuple(v.ravel() for v in np.meshgrid(H, h, angle, azimuth, indexing="ij"))


def angle_between(a, b):
    """Angle [rad] between vectors (K, 3) of about any length, accurate for small ones."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def there_and_back(kind, n):
    """Rays, the points where they end, and the directions in which those appear, as float64 (K, 3)."""
    H, h, angle, azimuth = geometry()
    sine = np.sin(angle)
    rays = array_of(kind, np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -np.cos(angle)], axis=-1))
    centres, water = array_of(kind, np.stack([0.0 * H, 0.0 * H, H], axis=-1)), FlatWater((0.0, 0.0, 0.0), n_water=n)
    points = trace(centres, rays, water).at_height(array_of(kind, -h), water)
    seen = project(points, centres, water)
    assert np.isfinite(as_double(seen.direction)).all()
    return as_double(rays), as_double(points), as_double(centres), as_double(seen.direction)


@pytest.mark.parametrize("n", INDICES)
@pytest.mark.parametrize("kind", DOUBLE)
def test_project_returns_the_traced_ray_in_float64(kind, n):
    rays, _, _, directions = there_and_back(kind, n)
    assert angle_between(rays, directions).max() < DOUBLE_RAD


@pytest.mark.parametrize("n", INDICES)
def test_project_returns_the_traced_ray_in_float32(n):
    rays, points, centres, directions = there_and_back("torch.float32", n)
    assert angle_between(rays, directions).max() < SINGLE_RAD
    # Against the direction in which the point that was kept appears, to the last digit of float64.
    exact = project(points, centres, FlatWater((0.0, 0.0, 0.0), n_water=n)).direction
    assert angle_between(exact, directions).max() < SOLVER_RAD
    assert np.abs(np.linalg.norm(directions, axis=-1) - 1.0).max() < 3 * EPS32


@pytest.mark.parametrize("kind", LIBRARIES)
def test_index_one_gives_the_straight_ray(rng, kind):
    """To the last bit down, in torch to one unit in the last place, since its roots are not rounded correctly on every
    processor; up to 4 units, against the unit vector from camera to point."""
    rays = rng.normal(size=(5000, 3)) - [0.0, 0.0, 1.0]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points, centre = rng.uniform([-30, -30, -9], [30, 30, 1], (5000, 3)), np.array([1.0, 2.0, 35.0])
    water = FlatWater((0.0, 0.0, 2.0), n_water=1.0, slope_x=0.01, slope_y=-0.02)
    centres = array_of(kind, np.tile(centre, (5000, 1)))
    path = trace(centres, array_of(kind, rays), water)
    unit = EPS32 if kind == "torch.float32" else EPS
    down = np.abs(as_double(path.water_direction) - as_double(path.air_direction))
    assert down.max() <= (unit if kind.startswith("torch") else 0.0)
    points = as_double(array_of(kind, points))
    straight = (points - centre) / np.linalg.norm(points - centre, axis=-1, keepdims=True)
    found = as_double(project(array_of(kind, points), centres, water).direction)
    assert np.abs(found - straight).max() <= 4 * unit / 2  # components of up to one have units of eps / 2


def converged(terms, like=None):
    """Angle in air [rad] for problems in their three numbers, after 0 to 8 steps of the solver."""
    a, b_squared, h = terms
    # n H = a and (n^2 - 1) D^2 = b^2, at an index of 1.333
    n = 1.333
    D_squared = b_squared / (n * n - 1.0)
    shares = [kernels.air_share(D_squared, a / n, h, n, steps, like) for steps in range(9)]
    return [np.arctan2(u * np.sqrt(D_squared), a / n) for u in shares]


def test_a_few_steps_reach_the_root_wherever_it_lies():
    """The problem has two numbers, h / a and b / a; this covers their plane, and the ridge where both are large."""
    rho = np.geomspace(1e-12, 1e12, 400)[:, None]
    eta = np.concatenate([np.geomspace(1e-12, 1e12, 400)[None, :] + 0.0 * rho, rho * np.linspace(0.5, 1.5, 401)], 1)
    angles = converged((np.ones_like(eta), eta**2, rho + 0.0 * eta))
    assert all(np.isfinite(a).all() for a in angles)
    error = [np.abs(a - angles[-1]).max() for a in angles]
    assert error[0] < 0.13
    assert error[2] < 1e-4
    # At a ratio of 1e12 the problem itself is not known better.
    assert error[ENOUGH_STEPS_DOUBLE] < 1e-9


def test_in_float32_the_last_step_gains_what_rounding_lost():
    rho = np.geomspace(1e-12, 1e6, 400)[:, None]  # 1 mm over 1 km of water
    eta = np.concatenate([np.geomspace(1e-12, 1e7, 400)[None, :] + 0.0 * rho, rho * np.linspace(0.5, 1.5, 401)], 1)
    terms = (np.ones_like(eta), eta**2, rho + 0.0 * eta)
    exact = converged(terms)[-1]
    found = converged(terms, like=np.ones(1, np.float32))[ENOUGH_STEPS_SINGLE]
    assert np.abs(found - exact).max() < 1e-9  # against 6e-8 of float32; measured 5e-11


def test_beyond_all_cameras_float32_stays_in_the_bracket():
    """A nanometre above ten metres of water and less: one cannot do better, but neither worse than this."""
    rho = np.geomspace(1e9, 1e14, 100)[:, None]
    eta = rho * np.linspace(0.0, 2.0, 401)
    terms = (np.ones_like(eta), eta**2, rho + 0.0 * eta)
    exact = converged(terms)[ENOUGH_STEPS_DOUBLE]
    for found in converged(terms, like=np.ones(1, np.float32)):
        assert np.abs(found - exact).max() < 0.7


def test_float32_far_from_the_origin_costs_the_rounding_of_the_coordinates(rng):
    """Half a unit in the last place of each, over the length of the air leg; the same in camera and point."""
    offset, legs = np.array([900.0, -700.0, 40.0]), np.array([0.0, 0.0, 30.0])
    water = FlatWater(tuple(offset), n_water=1.34)
    rays = rng.normal(size=(5000, 3)) * [0.4, 0.4, 0.0] - [0.0, 0.0, 1.0]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = torch.tensor(offset + legs).float()
    points = trace(centre, torch.tensor(rays).float(), water).at_height(torch.tensor(-4.0), water)
    seen = project(points, centre, water).direction.double().numpy()
    step = 2.0**-15  # half a unit of coordinates of 512 m to 1024 m
    assert angle_between(seen, rays).max() < math.sqrt(3.0) * step / 30.0 + 4 * EPS32
