"""Of no rays, points or numbers every function gives no results, in each of the three libraries."""

from __future__ import annotations

from dataclasses import fields, is_dataclass

import numpy as np
import pytest
import torch
from surface_rays import Bowl, llvm

import refract
from refract import FlatWater, bend, bend_regime, crossing_point, project, regime_counts, trace
from refract.curved import BicubicWater, WavyWater

PLANE = FlatWater((0.0, 0.0, 0.0), slope_x=0.1)
WATERS = {
    "none": None,
    "level plane": FlatWater((0.0, 0.0, 0.0)),
    "plane": PLANE,
    "waves": WavyWater((0.0, 0.0, 0.0), (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2))),
    "height and gradient": Bowl(0.0, b=1e-4),
    "cubic pieces": BicubicWater((-20.0, -20.0), 8.0, np.zeros((6, 6))),
}
ONLY_NUMPY_AND_TORCH = ("cubic pieces",)


def empty(library):
    """No vectors, no numbers, and one vector."""
    if library == "numpy":
        return np.zeros((0, 3)), np.zeros(0), np.array([0.0, 0.0, 1.0])
    if library == "torch":
        return torch.zeros((0, 3)), torch.zeros(0), torch.tensor([0.0, 0.0, 1.0])
    ad = llvm()
    return ad.Array3f(np.zeros((3, 0))), ad.Float(np.zeros(0)), ad.Array3f(0.0, 0.0, 1.0)


def sizes(found):
    """How many numbers there are in each array of a result."""
    if isinstance(found, dict):
        return list(found.values())
    if isinstance(found, tuple | list):
        return [size for each in found for size in sizes(each)]
    if is_dataclass(found):
        return [size for each in fields(found) if each.name[0] != "_" for size in sizes(getattr(found, each.name))]
    return [int(np.prod(found.shape))] if hasattr(found, "shape") else []


def over_water(water, none, numbers, one):
    """What `trace` and `project` say, of no rays from one camera, of no rays from no cameras and so on."""
    for camera, vectors in ((one, none), (none, none), (none, one)):
        path, seen = trace(camera, vectors, water), project(vectors, camera, water)
        yield path, path.regime, path.regime_counts(), path.at(numbers), path.at(2.0)
        yield seen, seen.crossing, seen.air_length, seen.water_length, seen.regime, seen.regime_counts()
        yield crossing_point(vectors, camera, water)
        if water is None or isinstance(water, FlatWater):
            yield path.at_height(numbers, water), path.at_height(-2.0, water)


@pytest.mark.parametrize("library", ["numpy", "torch", "drjit"])
@pytest.mark.parametrize("name", list(WATERS))
def test_of_no_rays_and_no_points_there_are_no_paths(name, library):
    if library == "drjit" and name in ONLY_NUMPY_AND_TORCH:
        pytest.skip(f"{name} run on numpy and torch")
    for found in over_water(WATERS[name], *empty(library)):
        assert sizes(found)
        assert not any(sizes(found))


FUNCTIONS = {
    "bend": lambda none, numbers, one: (
        bend(none, one, n_from=1.0, n_to=1.3), bend(none, none, n_from=1.3, n_to=1.0),
        bend_regime(one, none, n_from=1.0, n_to=1.3), regime_counts(numbers),
    ),
    "depths": lambda none, numbers, one: (PLANE.depth(none), PLANE.height(numbers, numbers)),
    "light": lambda none, numbers, one: refract.fresnel_coefficients(numbers, n_from=1.0, n_to=1.3),
    "indices": lambda none, numbers, one: (
        refract.water_index(numbers, 15.0, 0.0), refract.channel_indices(numbers, 0.0),
    ),
}  # fmt: skip
for _name in ("apparent_depth", "true_depth", "apparent_depth_tangential", "tangential_shift"):
    FUNCTIONS[_name] = lambda none, numbers, one, function=getattr(refract, _name): (
        function(numbers, 0.1, n_water=1.33), function(2.0, numbers, n_water=1.33),
    )  # fmt: skip


@pytest.mark.parametrize("library", ["numpy", "torch", "drjit"])
@pytest.mark.parametrize("name", list(FUNCTIONS))
def test_of_no_numbers_there_are_no_results(name, library):
    found = sizes(FUNCTIONS[name](*empty(library)))
    assert found
    assert not any(found)
