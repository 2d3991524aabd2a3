"""A number of the water for each ray: levels, slopes, tides and indices of shape (...), and one per channel."""

import numpy as np
import pytest
import torch
from slow_cases import slow
from surface_rays import DOUBLE, array_of, as_double

from refract import FlatWater, channel_indices, crossing_point, project, trace

CENTRE = np.array([1.0, 2.0, 30.0])
COUNT = 7


def scene(rng):
    """Rays, bed points, and numbers of the water, one for each."""
    rays = np.concatenate([rng.uniform(-0.5, 0.5, (COUNT, 2)), -np.ones((COUNT, 1))], axis=-1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points = rng.uniform([-20, -20, -9], [20, 20, -2], (COUNT, 3))
    numbers = rng.uniform(0, 1, COUNT), rng.uniform(1.32, 1.35, COUNT), *rng.uniform(-0.05, 0.05, (2, COUNT))
    return rays, points, numbers


def water_of(level, index, slope_x, slope_y):
    return FlatWater((0.3, -0.2, level), n_water=index, slope_x=slope_x, slope_y=slope_y)


def told(rays, points, centre, water, height):
    """Everything that is said of rays and points."""
    path, seen = trace(centre, rays, water), project(points, centre, water)
    return (
        path.crossing, path.air_length, path.water_direction, path.at_height(height, water),
        seen.direction, seen.crossing, seen.air_length, seen.water_length, seen.depth,
        crossing_point(points, centre, water),
    )  # fmt: skip


@pytest.mark.parametrize("numbers_from", ["same library", "numpy"])
@pytest.mark.parametrize("library", DOUBLE)
def test_each_ray_has_its_own_water(rng, library, numbers_from):
    rays, points, water = scene(rng)
    expected = [told(rays[i], points[i], CENTRE, water_of(*(v[i] for v in water)), -1.5) for i in range(COUNT)]
    if numbers_from == "same library":
        water = [array_of(library, v) for v in water]
    found = told(*(array_of(library, v) for v in (rays, points, CENTRE)), water_of(*water), -1.5)
    for one, each in zip(found, zip(*expected, strict=True), strict=True):
        np.testing.assert_allclose(as_double(one), np.stack(each), rtol=1e-13, atol=1e-13)


def test_an_index_per_channel_is_one_more_axis(rng):
    rays, points, _ = scene(rng)
    indices = np.array(channel_indices(15.0, 0.0))
    assert indices.shape == (3,)
    water = FlatWater((0.0, 0.0, 0.5), n_water=indices)
    path, seen = trace(CENTRE, rays[:, None], water), project(points[:, None], CENTRE, water)
    assert path.water_direction.shape == path.crossing.shape == path.origin.shape == (COUNT, 3, 3)
    assert path.air_length.shape == path.wet.shape == seen.depth.shape == (COUNT, 3)
    for channel, index in enumerate(indices):
        single = FlatWater((0.0, 0.0, 0.5), n_water=index)
        one = trace(CENTRE, rays, single)
        np.testing.assert_array_equal(path.water_direction[:, channel], one.water_direction)
        np.testing.assert_array_equal(path.at_height(-2.0, water)[:, channel], one.at_height(-2.0, single))
        np.testing.assert_allclose(seen.direction[:, channel], project(points, CENTRE, single).direction, atol=1e-15)


@pytest.mark.parametrize("library", DOUBLE)
def test_an_index_per_channel_without_its_axis_is_refused_in_words(rng, library):
    rays, points, _ = scene(rng)
    of_rays, of_points = array_of(library, rays), array_of(library, points)
    water = FlatWater((0.0, 0.0, 0.5), n_water=array_of(library, channel_indices(15.0, 0.0)))
    for call in (lambda: trace(CENTRE, of_rays, water), lambda: project(of_points, CENTRE, water)):
        with pytest.raises(ValueError, match=r"broadcast against rays \(7,\).*\(3,\).*rays\[\.\.\., None, :\]"):
            call()


def test_gradients_flow_to_the_level_of_each_ray(rng):
    _, points, numbers = scene(rng)
    level = torch.tensor(numbers[0], requires_grad=True)
    seen = project(torch.tensor(points), torch.tensor(CENTRE), water_of(level, *numbers[1:]))
    seen.direction[2].sum().backward()
    assert (level.grad != 0.0).tolist() == [i == 2 for i in range(COUNT)]


@pytest.mark.parametrize("name", [slow("trace"), "project", slow("at_height"), slow("crossing_point")])
def test_torch_compiles_it_whole(rng, name):
    rays, points, _ = scene(rng)
    rays, points, centre = torch.tensor(rays), torch.tensor(points), torch.tensor(CENTRE)

    def down(level):
        return trace(centre, rays, FlatWater((0.0, 0.0, level)))

    def function(level):
        if name == "project":
            found = project(points, centre, FlatWater((0.0, 0.0, level)))
            return torch.cat([found.direction, found.crossing, found.air_length[:, None]], dim=-1)
        if name == "crossing_point":
            return crossing_point(points, centre, FlatWater((0.0, 0.0, level)))
        path = down(level)
        return path.water_direction if name == "trace" else path.at_height(-2.0, FlatWater((0.0, 0.0, level)))

    level = torch.tensor(0.2, dtype=torch.float64)
    compiled = torch.compile(function, fullgraph=True, backend="eager")
    np.testing.assert_allclose(compiled(level), function(level), rtol=1e-13, atol=1e-13)


@pytest.mark.gpu
def test_a_gpu_finds_the_same(rng):
    rays, points, numbers = scene(rng)
    found = []
    for place in ("cpu", "cuda"):
        vectors, of_water = ([torch.tensor(v).to(place) for v in each] for each in ((rays, points, CENTRE), numbers))
        found.append(told(*vectors, water_of(*of_water), -1.5))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(other.cpu(), one, rtol=1e-13, atol=1e-13)
