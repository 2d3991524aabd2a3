"""torch.compile(fullgraph=True) of every surface: the same values and gradients, to rounding, as without."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from slow_cases import slow

from refract import FlatWater, ParallelLayers, project, trace
from refract.curved import AnySurface, BicubicWater, HeightFieldWater, SphericalWater, WavyWater

# Of values of tens of metres and their derivatives; with the backends "eager" and "aot_eager" none differs at all.
ROUNDING = {"rtol": 1e-12, "atol": 1e-12}
CENTRE = torch.tensor([1.0, 2.0, 30.0], dtype=torch.float64)
# Bent, bent, from a dry point and to no number; down, down and up.
POINTS = torch.tensor([[4.0, 1.0, -3.0], [-5.0, 3.0, -1.0], [2.0, 0.0, 1.0], [np.nan, 0.0, 0.0]], dtype=torch.float64)
RAYS = torch.tensor([[0.6, 0.0, -0.8], [0.0, 0.6, -0.8], [0.0, -0.6, 0.8]], dtype=torch.float64)
NODES = np.linspace(-20.0, 20.0, 6)
RELIEF = torch.tensor(0.05 * np.sin(NODES) * np.cos(NODES[:, None]))
OUTSIDE = HeightFieldWater.from_raster(NODES, NODES, RELIEF)


class Bowl(AnySurface):
    def __init__(self, level, n_water):
        self.level, self.n_water = level, n_water

    def height(self, x, y):
        return self.level + 1e-4 * (x * x + y * y)

    def normal(self, x, y):
        up = 1.0 / torch.sqrt(1.0 + 4e-8 * (x * x + y * y))
        return -2e-4 * x * up, -2e-4 * y * up, up


WATERS = {
    "plane": lambda level, n: FlatWater((0.0, 0.0, level), n_water=n, slope_x=0.01),
    "layers": lambda level, n: ParallelLayers((0.0, 0.0, level), (0.1, 0.0, 1.0), (1.0, 1.5, n), (0.01,)),
    "sphere": lambda level, n: SphericalWater((0.0, 0.0, level), n_water=n),
    "waves": lambda level, n: WavyWater((0.0, 0.0, level), (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2)), n_water=n),
    "triangles": lambda level, n: HeightFieldWater.from_raster(NODES, NODES, level + RELIEF, n_water=n),
    "triangles made before": lambda level, n: OUTSIDE,
    "cubic pieces": lambda level, n: BicubicWater((-20.0, -20.0), 8.0, level + RELIEF, n_water=n),
    "height and normal": Bowl,
}


def told(name, way):
    """A function of level, index and camera."""

    def function(level, n, centre):
        water = WATERS[name](level, n)
        if way == "project":
            seen = project(POINTS, centre, water)
            return seen.direction, seen.crossing, seen.air_length, seen.water_length, seen.depth, seen.num_paths
        path = trace(centre, RAYS, water)
        if name == "layers":
            return *path.directions, *path.crossings, *path.lengths
        return path.water_direction, path.crossing, path.air_length, path.at(torch.tensor(45.0).double())

    return function


def values_and_gradients(function):
    leaves = [v.clone().requires_grad_() for v in (torch.tensor(0.1), torch.tensor(1.34), CENTRE)]
    leaves = [leaf.detach().double().requires_grad_() for leaf in leaves]
    found = function(*leaves)
    total = sum(torch.where(v.isfinite(), v, 0.0).sum() for v in found if v.requires_grad)
    return [v.detach() for v in found], torch.autograd.grad(total, leaves, allow_unused=True)


def hold_together(function, backend):
    torch._dynamo.reset()
    compiled = values_and_gradients(torch.compile(function, fullgraph=True, backend=backend))
    for found, expected in zip(compiled, values_and_gradients(function), strict=True):
        for one, other in zip(found, expected, strict=True):
            assert (one is None) == (other is None)
            if one is not None:
                torch.testing.assert_close(one, other, equal_nan=True, **ROUNDING)


@pytest.mark.filterwarnings("ignore:To copy construct from a tensor")  # torch of itself, over arrays of numpy
@pytest.mark.parametrize(
    ("name", "way"),
    [
        ("plane", "project"),
        ("waves", "trace"),
        slow("plane", "trace"),
        slow("waves", "project"),
        slow("triangles made before", "trace"),
        slow("triangles made before", "project"),
    ],
)
def test_torch_compiles_any_water_whole(name, way):
    hold_together(told(name, way), "eager")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:To copy construct from a tensor")
@pytest.mark.parametrize("way", ["trace", "project"])
@pytest.mark.parametrize("name", ["layers", "sphere", "triangles", "cubic pieces", "height and normal"])
def test_torch_compiles_the_others_whole(name, way):
    hold_together(told(name, way), "eager")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:To copy construct from a tensor")
@pytest.mark.parametrize("way", ["trace", "project"])
@pytest.mark.parametrize("name", list(WATERS))
def test_what_is_traced_backward_too_is_the_same(name, way):
    hold_together(told(name, way), "aot_eager")


def test_a_raster_is_compiled_once_for_all_of_its_heights():
    calls = []

    def counted(graph, inputs):
        calls.append(graph)
        return graph.forward

    torch._dynamo.reset()
    compiled = torch.compile(told("triangles made before", "project"), fullgraph=True, backend=counted)
    for level in (0.1, 0.2, 0.3):
        compiled(torch.tensor(level).double(), torch.tensor(1.34).double(), CENTRE)
    assert len(calls) == 1
