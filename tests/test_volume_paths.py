"""Bent paths through a box: where they enter and leave it, and where they stand, against the paths of `refract`."""

import numpy as np
import pytest
import torch
from volume_scenes import BOX, WATER, looking_down

from fields.volume.paths import Box, Paths, paths_of
from refract import FlatWater, fresnel_coefficients
from refract.curved import WavyWater

# Positions of some metres in float32: half a step is 0.12 um for 2 m, and a path adds up a dozen roundings.
FLOAT32_M = 3e-6


def whole(camera, water, box=BOX, view=0) -> Paths:
    pixels = camera.pixel_centres().reshape(-1, 2)
    return paths_of(camera, water, pixels, np.full((len(pixels), 3), 128, dtype=np.uint8), box, view)


@pytest.mark.parametrize(
    "water",
    [
        None,
        WATER,
        FlatWater((0.0, 0.0, 0.0), n_water=1.333, slope_x=0.05),
        FlatWater((0.0, 0.0, 0.0), n_water=1.0),
        WavyWater((0.0, 0.0, 0.0), (0.02,), ((1.0, 0.5),), n_water=1.333),
    ],
)
@pytest.mark.parametrize("tilt", [0.0, 0.6])
def test_positions_are_those_of_the_bent_paths(water, tilt):
    camera = looking_down(tilt=tilt)
    paths = whole(camera, water)
    bent = camera.paths(camera.pixel_centres().reshape(-1, 2), water)
    s = np.linspace(0.1, 7.0, 9)
    expected = np.stack([bent.at(np.full(len(paths), v)) for v in s], axis=1)
    found = paths.at(torch.as_tensor(s, dtype=torch.float32).expand(len(paths), -1)).numpy()
    np.testing.assert_allclose(found, expected, atol=FLOAT32_M)


@pytest.mark.parametrize("water", [None, WATER])
@pytest.mark.parametrize("tilt", [0.0, 0.7, 1.2])
@pytest.mark.parametrize("box", [BOX, Box(np.array([-1.0, -1.0, -1.5]), np.array([1.5, 1.0, 0.8]))])
def test_a_path_is_inside_its_box_between_near_and_far_and_nowhere_else(water, tilt, box):
    paths = whole(looking_down(tilt=tilt), water, box)
    s = torch.linspace(0.0, 24.0, 4801).expand(len(paths), -1)
    x = paths.at(s).double().numpy()
    inside = ((x > box.low + 1e-4) & (x < box.high - 1e-4)).all(axis=-1)
    between = ((s > paths.near[:, None] - 1e-4) & (s < paths.far[:, None] + 1e-4)).numpy()
    assert inside.any()
    assert not (inside & ~between).any()
    # Both ends are met to a step of 5 mm, and the middle may leave the box only where the path is bent.
    first, last = s[0, inside.argmax(axis=1)], s[0, 4800 - inside[:, ::-1].argmax(axis=1)]
    met = inside.any(axis=1)
    np.testing.assert_allclose(paths.near[met], first[met], atol=0.011)
    np.testing.assert_allclose(paths.far[met], last[met], atol=0.011)
    short = (paths.far - paths.near).numpy()[~met]
    assert (short < 0.02).all()


def test_a_camera_inside_the_box_begins_there_and_one_that_looks_away_misses_it():
    inside = whole(looking_down(-1.0, tilt=0.2), None)
    assert (inside.near == 0.0).all()
    assert (inside.far > 0.3).all()
    away = whole(looking_down(tilt=np.pi), None)
    assert (away.near == away.far).all()


def test_rays_along_a_face_are_inside_between_the_faces_and_outside_beyond():
    box = Box(np.zeros(3), np.ones(3))
    origin = np.array([[0.5, -1.0, 0.5], [2.0, -1.0, 0.5], [0.0, -1.0, 0.5]])
    near, far = box.crossed(origin, np.tile([0.0, 1.0, 0.0], (3, 1)))
    np.testing.assert_array_equal(near[[0, 2]], 1.0)
    np.testing.assert_array_equal(far[[0, 2]], 2.0)
    assert near[1] > far[1]


def test_the_direction_is_that_of_the_medium_and_only_the_wet_part_counts_as_water():
    camera = looking_down(tilt=0.5)
    paths = whole(camera, WATER)
    bent = camera.paths(camera.pixel_centres().reshape(-1, 2), WATER)
    before, after = paths.crossing - 0.01, paths.crossing + 0.01
    np.testing.assert_allclose(paths.direction(before[:, None])[:, 0], bent.air_direction, atol=1e-6)
    np.testing.assert_allclose(paths.direction(after[:, None])[:, 0], bent.water_direction, atol=1e-6)
    np.testing.assert_allclose(paths.length_in_water(before), 0.0)
    np.testing.assert_allclose(paths.length_in_water(after), 0.01, atol=FLOAT32_M)
    falls = -bent.air_direction[:, 2]
    expected = fresnel_coefficients(falls, n_from=1.0, n_to=1.333).reflectance
    np.testing.assert_allclose(paths.reflectance, expected, rtol=1e-5)
    dry = whole(camera, None)
    assert (dry.reflectance == 0.0).all()
    assert torch.isinf(dry.crossing).all()


@pytest.mark.parametrize(("low", "high"), [((0, 0), (1, 1)), ((0, 0, 1), (1, 1, 1)), ((0, 0, np.nan), (1, 1, 1))])
def test_a_box_that_is_none_is_refused(low, high):
    with pytest.raises(ValueError, match="expected corners"):
        Box(np.array(low, dtype=float), np.array(high, dtype=float))
