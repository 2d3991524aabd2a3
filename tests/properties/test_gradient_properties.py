"""No single ray or point makes the gradient of what it shares with others NaN."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_cases import slow

from refract import FlatWater, project, trace
from refract.curved import BicubicWater, WavyWater

few = settings(max_examples=30)
# Coordinates [m] of every magnitude that a float32 has, and what is no number.
POWER = st.builds(
    lambda sign, power: float(np.float32(sign * 10.0**power)), st.sampled_from([-1, 1]), st.floats(-5, 38.5)
)
COORDINATE = st.one_of(
    st.floats(-1e3, 1e3, width=32), POWER, st.sampled_from([0.0, np.nan, np.inf, -np.inf, 1e-40, -1e-20, 1e15, -3e38])
)
TRIPLE = st.tuples(COORDINATE, COORDINATE, COORDINATE)
HEIGHT = st.floats(0.0, 1e4, width=32)


def shared_gradients(told, leaves):
    """Gradients of the sum of all that is finite."""
    total = sum(v[torch.isfinite(v)].sum() for v in told)
    return torch.autograd.grad(total, leaves, allow_unused=True)


@pytest.mark.parametrize("dtype", [torch.float32, slow(torch.float64)])
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


def test_cameras_that_touch_deep_water_see_it_in_float32_as_in_float64():
    """Where a camera is 1e19 times lower than the water is deep, squares of float32 overflow."""
    rng = np.random.default_rng(5)
    sides, depths, heights = (10.0 ** rng.uniform(low, high, 20_000) for low, high in ((5, 13), (8, 14), (-14, -8)))
    points = torch.tensor(np.stack([sides, sides * 0.0, -depths], axis=1), dtype=torch.float32)
    cameras = torch.tensor(np.stack([sides * 0.0, sides * 0.0, heights], axis=1), dtype=torch.float32)
    points.requires_grad_()
    cameras.requires_grad_()
    water = FlatWater((0.0, 0.0, 0.0), slope_x=0.01)
    seen, exact = project(points, cameras, water), project(points.double(), cameras.double(), water)
    assert (seen.wet == exact.wet).all()
    # Which side of the bracket is known there and no more (docs/optics.md): 0.6 rad.
    assert float((seen.direction.double() - exact.direction).detach().abs().max()) < 0.6
    told = seen.direction, seen.crossing, seen.air_length, seen.water_length
    for gradient in shared_gradients(told, (points, cameras)):
        assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("dtype", [torch.float32, slow(torch.float64)])
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


NODES = np.linspace(-20.0, 20.0, 6)
RELIEF = 0.05 * np.sin(NODES) * np.cos(NODES[:, None])


def every_water(level, n):
    """One of each kind, with the level and the index that they share."""
    z = level + torch.tensor(RELIEF, dtype=level.dtype)
    return {
        "plane": FlatWater((0.0, 0.0, level), n_water=n, slope_x=0.01),
        "waves": WavyWater((0.0, 0.0, level), (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2)), n_water=n),
        "cubic pieces": BicubicWater((-20.0, -20.0), 8.0, z, n_water=n),
    }


KINDS = ("plane", "waves", "cubic pieces")
# Rounding is the risk, and float32 rounds more.
MORE = [("waves", torch.float64)]
# Cubic pieces take a quarter of a minute.
CASES = [
    slow(kind, dtype) if kind == "cubic pieces" or (kind, dtype) in MORE else (kind, dtype)
    for dtype in (torch.float32, torch.float64)
    for kind in KINDS
]


@pytest.mark.parametrize(("kind", "dtype"), CASES)
@few
@given(far=TRIPLE)
def test_no_point_camera_or_origin_makes_a_gradient_shared_over_any_water_nan(kind, dtype, far):
    camera, level, n = (torch.tensor(v, dtype=dtype, requires_grad=True) for v in ([1.0, 2.0, 30.0], 0.0, 1.333))
    water, place = every_water(level, n)[kind], torch.tensor(far, dtype=dtype)
    points = torch.stack([torch.tensor([4.0, 1.0, -3.0], dtype=dtype), place])
    told = []
    for end, eye in ((points, camera), (points[:1], torch.stack([camera, place]))):
        seen = project(end, eye, water)
        told += [seen.direction, seen.crossing, seen.air_length, seen.water_length, seen.depth]
    rays = torch.tensor([[0.6, 0.0, -0.8], [0.0, 0.6, 0.8], [0.0, -0.6, -0.8]], dtype=dtype)
    path = trace(torch.stack([camera, camera, place]), rays, water)
    told += [path.crossing, path.air_length, path.water_direction]
    gradients = shared_gradients(told, (camera, level, n))
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert all(gradient.abs().sum() > 0.0 for gradient in gradients)


@pytest.mark.parametrize("water", [None, FlatWater((0.0, 0.0, 0.0))])
def test_what_is_out_of_reach_is_no_number(water):
    far = np.array([[4.0, 1.0, -3.0], [9e14, 0.0, -3.0], [1.1e15, 0.0, -3.0], [0.0, -1e200, -3.0]])
    assert np.isnan(project(far, np.array([1.0, 2.0, 30.0]), water).depth).tolist() == [False, False, True, True]
    assert np.isnan(trace(-far, np.array([0.6, 0.0, -0.8]), water).air_length).tolist() == [False, False, True, True]
