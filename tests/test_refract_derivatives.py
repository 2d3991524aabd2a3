"""First and second derivatives of `project` and `trace` in torch: every mode against 50 digits."""

from __future__ import annotations

import mpmath
import numpy as np
import pytest
import torch
from fifty_digits import exact_derivatives, worst
from torch.func import hessian, jacfwd, jacrev, jvp, vmap

from refract import FlatWater, project, trace

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


def seen(numbers):
    """Direction, crossing, lengths and depth from the ten numbers of a case."""
    water = FlatWater((0.3, -0.2, numbers[6]), n_water=numbers[7], slope_x=numbers[8], slope_y=numbers[9])
    found = project(numbers[3:6], numbers[:3], water)
    lengths = torch.stack([found.air_length, found.water_length, found.depth])
    return torch.cat([found.direction, found.crossing, lengths])


def seen_exactly(numbers):
    """`seen` in mpmath, with the share of the way that lies in air found by Newton's steps in all digits."""
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
    assert worst(jacrev(seen)(numbers), first) < FIRST
    assert worst(jacfwd(seen)(numbers), first) < FIRST
    assert worst(hessian(seen)(numbers), second) < SECOND
    assert worst(jacrev(jacrev(seen))(numbers), second) < SECOND


def traced(numbers):
    water = FlatWater((0.3, -0.2, numbers[6]), n_water=numbers[7], slope_x=numbers[8], slope_y=numbers[9])
    ray = numbers[3:6] - numbers[:3]
    path = trace(numbers[:3], ray / ray.norm(), water)
    return torch.cat([path.crossing, path.water_direction, path.air_length[None], path.at_height(-2.0, water)])


def test_trace_has_the_same_derivatives_in_both_modes():
    for numbers in CASES.values():
        numbers = torch.tensor(numbers, dtype=torch.float64)
        forward, reverse = jacfwd(traced)(numbers), jacrev(traced)(numbers)
        np.testing.assert_allclose(forward, reverse, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(jacfwd(jacrev(traced))(numbers), jacrev(jacfwd(traced))(numbers), atol=1e-9)


@pytest.mark.parametrize("function", [seen, traced])
def test_vmap_over_all_numbers_is_the_loop_over_them(function):
    numbers = torch.tensor(list(CASES.values()), dtype=torch.float64)
    each = torch.stack([function(row) for row in numbers])
    np.testing.assert_allclose(vmap(function)(numbers), each, rtol=1e-13, atol=1e-13)
    tangents = torch.ones_like(numbers)
    outside, inside = jvp(vmap(function), (numbers,), (tangents,)), vmap(lambda x, t: jvp(function, (x,), (t,)))
    np.testing.assert_allclose(outside[1], inside(numbers, tangents)[1], rtol=1e-11, atol=1e-12)
