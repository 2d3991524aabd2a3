"""No single ray or point makes the gradient of what it shares with others NaN."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from refract import FlatWater, ParallelLayers, project, trace

# The same examples every time; no deadline, because the first example pays for imports.
always = settings(max_examples=100, deadline=None, derandomize=True)
# Coordinates [m] of any size that a scene may have, and what is no number; the squares of larger ones overflow.
COORDINATE = st.one_of(
    st.floats(-1e9, 1e9, width=32), st.sampled_from([0.0, float("nan"), float("inf"), -float("inf"), 1e-40, -1e-20])
)
TRIPLE = st.tuples(COORDINATE, COORDINATE, COORDINATE)
HEIGHT = st.floats(0.0, 1e4, width=32)


def shared_gradients(told, leaves):
    """Gradients of the sum of all that is finite."""
    total = sum(v[torch.isfinite(v)].sum() for v in told)
    return torch.autograd.grad(total, leaves, allow_unused=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@always
@given(point=TRIPLE, height=HEIGHT, slope=st.floats(-0.5, 0.5, width=32), index=st.floats(1.0, 1.625, width=32))
def test_no_point_makes_a_shared_gradient_nan(dtype, point, height, slope, index):
    camera, level, tilt, n = (
        torch.tensor(v, dtype=dtype, requires_grad=True) for v in ([1.0, 2.0, height], 0.0, slope, index)
    )
    points = torch.tensor([[4.0, 1.0, -3.0], point], dtype=dtype)
    seen = project(points, camera, FlatWater((1.0, 2.0, level), n_water=n, slope_x=tilt))
    told = seen.direction, seen.crossing, seen.air_length, seen.water_length, seen.depth
    for gradient in shared_gradients(told, (camera, level, tilt, n)):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@always
@given(ray=TRIPLE, height=HEIGHT, slope=st.floats(-0.5, 0.5, width=32), index=st.floats(1.0, 1.625, width=32))
def test_no_ray_makes_a_shared_gradient_nan(dtype, ray, height, slope, index):
    camera, level, tilt, n = (
        torch.tensor(v, dtype=dtype, requires_grad=True) for v in ([1.0, 2.0, height], 0.0, slope, index)
    )
    unit = torch.nn.functional.normalize(torch.tensor(ray, dtype=torch.float64), dim=0).to(dtype)
    rays = torch.stack([torch.tensor([0.6, 0.0, -0.8], dtype=dtype), unit, torch.tensor(ray, dtype=dtype)])
    water = FlatWater((1.0, 2.0, level), n_water=n, slope_x=tilt)
    path = trace(camera, rays, water)
    told = path.crossing, path.air_length, path.water_direction, path.at_height(-2.0, water)
    for gradient in shared_gradients(told, (camera, level, tilt, n)):
        assert torch.isfinite(gradient).all()


@always
@given(point=TRIPLE)
def test_no_point_behind_layers_makes_a_shared_gradient_nan(point):
    camera, glass = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in ([0.0, 0.0, 0.0], 0.01))
    port = ParallelLayers((0.0, 0.0, 0.03), (0.0, 0.0, -1.0), (1.0, 1.5, 1.34), (glass,))
    points = torch.tensor([[0.1, 0.0, 1.0], point], dtype=torch.float64)
    seen = project(points, camera, port)
    told = seen.direction, seen.air_length, seen.water_length, port.project(points, camera)
    for gradient in shared_gradients(told, (camera, glass)):
        assert torch.isfinite(gradient).all()
