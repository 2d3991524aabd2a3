"""Pixels that may see the area: all that do are among them, and heights are searched in no others."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, match, ring

from fields.sweep.tiles import CornerRays, side_of_squares
from fields.sweep.view_pass import columns_over_area, columns_seeing_area

AREA, BOUND = (-0.35, -0.25, 0.2, 0.3), (-2.3, -1.9)
BED = PlaneBed(TILTED, -2.0)


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_columns_hold_every_pixel_that_sees_the_area_within_the_bound_and_not_all_others(water):
    for camera in ring(6):
        columns = columns_seeing_area(camera, water, AREA, BOUND, 1)
        path, across = camera.paths(camera.pixel_centres(), water), np.arange(camera.width)
        sees = np.zeros((camera.height, camera.width), dtype=bool)
        for height in np.linspace(*BOUND, 9):
            x, y, _ = np.moveaxis(path.at_height(height, water), -1, 0)
            sees |= (x > AREA[0]) & (x < AREA[2]) & (y > AREA[1]) & (y < AREA[3])
        inside = (across >= columns[:, :1]) & (across < columns[:, 1:])
        assert sees.any()
        assert inside[sees].all()
        assert inside.mean() < sees.mean() + 0.5


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_columns_by_heights_hold_the_pixels_over_the_area_and_fewer_than_those_of_the_bound(water):
    for camera in ring(6):
        coarse, across = camera.scaled(0.5), np.arange(camera.width)
        # Half of a step of 0.4 m: both heights count beside it.
        before = np.where(np.arange(coarse.width) < coarse.width // 2, *BOUND) + np.zeros((coarse.height, 1))
        rays_of = partial(CornerRays.of, camera, water)
        columns = columns_over_area(camera, (camera.height, camera.width), AREA, before.astype(np.float32), rays_of)
        path = camera.paths(camera.pixel_centres(), water)
        x, y, _ = np.moveaxis(path.at_height(np.where(across < camera.width // 2, *BOUND), water), -1, 0)
        over = (x > AREA[0]) & (x < AREA[2]) & (y > AREA[1]) & (y < AREA[3])
        inside = (across >= columns[:, :1]) & (across < columns[:, 1:])
        bound = columns_seeing_area(camera, water, AREA, BOUND, 1)
        assert inside[over].all()
        assert over.any()
        assert over.mean() < inside.mean() < (bound[:, 1] - bound[:, 0]).sum() / inside.size


def test_an_area_beside_the_image_needs_no_pixel():
    columns = columns_seeing_area(ring(6)[0], TILTED, (50.0, 50.0, 51.0, 51.0), BOUND, 2)
    assert (columns[:, 0] == columns[:, 1]).all()


def test_wanted_columns_have_the_heights_of_a_whole_image_and_the_others_none(device):
    cameras, step, count, radius = ring(6), 0.04, 9, 2
    stack = BED.stack(device, cameras)
    start = (BED.true_height(cameras[0]) - step * (count // 2)).astype(np.float32)
    columns = np.tile([0, 0], (stack.height, 1))
    columns[20:50] = 31, 64
    part, whole = (match(stack, [1, 2, 3, 4, 5, 6], start, step, count, radius, each) for each in (columns, None))
    for found, expected in zip(part, whole, strict=True):
        np.testing.assert_allclose(found[20:50, 31:64], expected[20:50, 31:64], rtol=1e-4, atol=1e-4)
    assert (part[1][:18] == -1.0).all()
    assert (part[1][:, 70:] == -1.0).all()


@pytest.mark.parametrize("tide", [0.0, 0.15])
@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_corner_rays_are_the_paths_of_pixels_on_both_sides_of_the_water(water, tide):
    camera = replace(ring(6)[2], tide=tide if water is not None else 0.0)
    rays = CornerRays.of(camera, water, (3, 5))
    side = side_of_squares(camera)
    row, column = np.mgrid[:4, :6] * float(side)
    paths = camera.paths(np.stack([column, row], axis=-1), water)
    for level in (-2.3, -0.4, 0.0, 0.1, 0.8):
        height = np.full(row.shape, level)
        expected = paths.at_height(height, water)[..., :2]
        np.testing.assert_allclose(rays.places(height.astype(np.float32)), expected, atol=1e-5)


@pytest.mark.parametrize("level", [-20.0, 0.0, 0.005, 1500.0])
def test_corner_rays_of_a_dry_camera_are_its_paths_wherever_the_frame_has_its_origin(level):
    camera = ring(6)[2]
    camera = replace(camera, centre=(*np.array(camera.centre)[:2], level))
    rays = CornerRays.of(camera, None, (3, 5))
    row, column = np.mgrid[:4, :6] * float(side_of_squares(camera))
    paths = camera.paths(np.stack([column, row], axis=-1), None)
    for over in (-12.0, -0.2, 0.3):
        height = np.full(row.shape, level + over)
        expected = paths.at_height(height, None)[..., :2]
        assert np.isnan(expected).all() == (over > 0.0)
        np.testing.assert_allclose(rays.places(height.astype(np.float32)), expected, atol=1e-3)
