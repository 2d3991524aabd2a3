"""First and second derivatives of `project` and `trace` over curved water: against differences in 50 digits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch
from fifty_digits import exact_derivatives, worst
from slow_cases import slow
from surface_rays import Bowl
from torch.func import hessian, jacfwd, jacrev

from refract import project, trace
from refract.curved import BicubicWater, WavyWater

# Of the largest derivative of a kind. Measured worst: 5e-15 and 5e-15.
FIRST, SECOND = 5e-14, 5e-14
# Camera, point, level and index.
NUMBERS = [1.0, 2.0, 30.0, 8.0, 3.0, -3.0, 0.2, 1.333]
AMPLITUDES, VECTORS, PHASES = (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2)), (0.3, 1.0)
BOWL = 1e-3
NODES = np.random.default_rng(3).uniform(-0.05, 0.05, (9, 9))


def water_of(name, level, index):
    if name == "bowl":
        return Bowl(level, index, BOWL)
    return WavyWater((0.3, -0.2, level), AMPLITUDES, VECTORS, PHASES, n_water=index)


def height_of(name, level, x, y):
    """Height and slopes in mpmath."""
    if name == "bowl":
        return level + BOWL * (x * x + y * y), 2 * BOWL * x, 2 * BOWL * y
    x, y = x - mpmath.mpf(0.3), y + mpmath.mpf(0.2)
    z, zx, zy = level, mpmath.mpf(0), mpmath.mpf(0)
    for a, (kx, ky), phase in zip(AMPLITUDES, VECTORS, PHASES, strict=True):
        angle = kx * x + ky * y + phase
        z, zx, zy = z + a * mpmath.sin(angle), zx + a * kx * mpmath.cos(angle), zy + a * ky * mpmath.cos(angle)
    return z, zx, zy


def seen(name, numbers):
    found = project(numbers[3:6], numbers[:3], water_of(name, numbers[6], numbers[7]))
    return torch.cat([found.direction, found.crossing, torch.stack([found.air_length, found.water_length])])


def seen_exactly(name, numbers, start):
    """`seen` in mpmath: the crossing where the optical length is stationary."""
    camera, point, (level, n) = numbers[:3], numbers[3:6], numbers[6:]

    def legs(x, y):
        z, zx, zy = height_of(name, level, x, y)
        air, water = ([c - e for c, e in zip((x, y, z), end, strict=True)] for end in (camera, point))
        return air, mpmath.norm(air), water, mpmath.norm(water), zx, zy

    def gradient(x, y):
        air, a, water, w, zx, zy = legs(x, y)
        return [(air[k] + z * air[2]) / a + n * (water[k] + z * water[2]) / w for k, z in enumerate((zx, zy))]

    x, y = mpmath.findroot(gradient, start, tol=1e-80)
    air, a, water, w, _, _ = legs(x, y)
    return [*(v / a for v in air), *(p + v for p, v in zip(point, water, strict=True)), a, w]


def traced(name, numbers):
    ray = numbers[3:6] - numbers[:3]
    path = trace(numbers[:3], ray / ray.norm(), water_of(name, numbers[6], numbers[7]))
    return torch.cat([path.crossing, path.water_direction, path.air_length[None]])


def traced_exactly(name, numbers, start):
    camera, (level, n) = numbers[:3], numbers[6:]
    ray = [p - c for p, c in zip(numbers[3:6], camera, strict=True)]
    ray = [v / mpmath.norm(ray) for v in ray]

    def at(t):
        return [c + t * v for c, v in zip(camera, ray, strict=True)]

    t = mpmath.findroot(lambda t: at(t)[2] - height_of(name, level, *at(t)[:2])[0], start, tol=1e-80)
    _, zx, zy = height_of(name, level, *at(t)[:2])
    up = [v / mpmath.sqrt(1 + zx * zx + zy * zy) for v in (-zx, -zy, mpmath.mpf(1))]
    cosine = -sum(r * u for r, u in zip(ray, up, strict=True)) / n
    push = cosine - mpmath.sqrt(1 - 1 / n**2 + cosine**2)
    return [*at(t), *(r / n + push * u for r, u in zip(ray, up, strict=True)), t]


@pytest.mark.parametrize("name", ["wavy", slow("bowl")])
@pytest.mark.parametrize("way", ["project", "trace"])
def test_derivatives_over_curved_water_are_those_of_fifty_digits(way, name):
    numbers = torch.tensor(NUMBERS, dtype=torch.float64)
    if way == "project":
        told, exactly = seen, seen_exactly
        start = [mpmath.mpf(float(v)) for v in seen(name, numbers)[3:5]]
    else:
        told, exactly, start = traced, traced_exactly, mpmath.mpf(float(traced(name, numbers)[-1]))
    first, second = exact_derivatives(lambda v: exactly(name, v, start), NUMBERS)
    for mode in (jacrev, jacfwd):
        assert worst(mode(lambda v: told(name, v))(numbers), first) < FIRST
    assert worst(hessian(lambda v: told(name, v))(numbers), second) < SECOND
    assert worst(jacrev(jacrev(lambda v: told(name, v)))(numbers), second) < SECOND


@pytest.mark.slow
def test_second_derivatives_over_cubic_pieces_pass_the_check_of_torch():
    def told(numbers):
        water = BicubicWater((-20.0, -20.0), 5.0, numbers[6] + torch.tensor(NODES), n_water=numbers[7])
        found, ray = project(numbers[3:6], numbers[:3], water), numbers[3:6] - numbers[:3]
        path = trace(numbers[:3], ray / ray.norm(), water)
        return torch.cat([found.direction, found.crossing, path.crossing, path.water_direction])

    numbers = torch.tensor(NUMBERS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(told, numbers, eps=1e-5, atol=1e-6)
