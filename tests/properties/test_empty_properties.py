"""Of no rays and no points `trace` and `project` give no results."""

from dataclasses import fields, is_dataclass

import numpy as np
import pytest
from surface_rays import DOUBLE, Bowl, array_of

from refract import FlatWater, crossing_point, project, trace
from refract.curved import BicubicWater, WavyWater

WATERS = {
    "none": None,
    "level plane": FlatWater((0.0, 0.0, 0.0)),
    "plane": FlatWater((0.0, 0.0, 0.0), slope_x=0.1),
    "waves": WavyWater((0.0, 0.0, 0.0), (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2))),
    "height and gradient": Bowl(0.0, b=1e-4),
    "cubic pieces": BicubicWater((-20.0, -20.0), 8.0, np.zeros((6, 6))),
}


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
        yield path, path.at(numbers), path.at(2.0)
        yield seen, seen.crossing, seen.air_length, seen.water_length
        yield crossing_point(vectors, camera, water)
        if water is None or isinstance(water, FlatWater):
            yield path.at_height(numbers, water), path.at_height(-2.0, water)


@pytest.mark.parametrize("library", DOUBLE)
@pytest.mark.parametrize("name", list(WATERS))
def test_of_no_rays_and_no_points_there_are_no_paths(name, library):
    none, numbers, one = (array_of(library, each) for each in (np.zeros((0, 3)), np.zeros(0), [0.0, 0.0, 1.0]))
    for found in over_water(WATERS[name], none, numbers, one):
        assert sizes(found)
        assert not any(sizes(found))
