"""Ghost points stand off a flat surface that many maps hold, and few maps hold them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from plane_survey import TILTED, ring
from test_sweep_steep import GSD, HEIGHT, PIXEL, SHAPE, masks

from fields.sweep.maps import HeightMap
from fields.sweep.overhangs import are_off_surface, without_ghosts

# A level square of 13 points on each side, one ground sampling distance apart, and its middle.
SIDE = np.arange(13.0)
SURFACE = np.stack([*(each.ravel() for each in np.meshgrid(SIDE, SIDE)), np.zeros(13 * 13)], axis=-1)
MIDDLE = 6.0, 6.0


def is_off(place, matching: int = 0, surface: np.ndarray = SURFACE, matching_about: int = 10) -> bool:
    return bool(
        are_off_surface(np.array([place]), np.array([matching]), surface, np.full(len(surface), matching_about))[0]
    )


@pytest.mark.parametrize(("off", "expected"), [(1.4, False), (1.6, True), (-1.6, True), (4.0, True), (6.1, False)])
def test_a_point_is_a_ghost_from_so_far_off_the_surface_to_where_this_says_nothing(off, expected):
    assert is_off([*MIDDLE, off]) == expected


def test_it_does_not_matter_how_the_surface_lies_in_space():
    turned, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    assert is_off(np.array((*MIDDLE, 3.0)) @ turned, surface=SURFACE @ turned)


@pytest.mark.parametrize(("matching", "expected"), [(2, True), (3, False)])
def test_what_a_fourth_of_the_maps_of_the_surface_match_is_no_ghost(matching, expected):
    assert is_off([*MIDDLE, 3.0], matching) == expected


def test_beside_the_rim_of_the_surface_nothing_is_a_ghost():
    assert not is_off([15.0, 6.0, 2.0])


def test_a_surface_that_few_maps_hold_or_a_line_or_rough_points_say_nothing():
    ghost = [*MIDDLE, 3.0]
    rough = SURFACE + [0.0, 0.0, 2.0] * np.random.default_rng(2).normal(size=(len(SURFACE), 1))
    assert not is_off(ghost, matching_about=3)
    assert not is_off(ghost, surface=SURFACE[SURFACE[:, 1] == 6.0])
    assert not is_off(ghost, surface=rough)


@pytest.mark.parametrize(("height", "stays"), [(HEIGHT + 0.08, False), (HEIGHT + 0.01, True)])
def test_pixels_beneath_a_step_go_where_they_stand_off_what_the_other_maps_hold(device, height, stays):
    over = HEIGHT + 0.4
    wrong = np.full(SHAPE, np.float32(height))
    wrong[:, PIXEL[1] + 4 :] = over
    heights = [wrong, *[np.full(SHAPE, np.float32(HEIGHT))] * 5, np.full(SHAPE, np.float32(over))]
    sure, none = np.full(SHAPE, 3, np.uint8), np.zeros(SHAPE, np.float16)
    maps = [HeightMap(view, each, none + 1, sure, none) for view, each in enumerate(heights)]
    kept = masks(len(maps), m0=True)
    kept[1] = kept[len(maps) - 1] = np.ones(SHAPE, bool)
    block = SimpleNamespace(cameras=ring(len(maps) - 1), water=TILTED, device=device)
    left = without_ghosts(block, maps, kept, GSD)
    assert bool(left[0][PIXEL]) == stays
    assert left[1].all()
    assert left[len(maps) - 1].all()
    assert kept[0][PIXEL]
