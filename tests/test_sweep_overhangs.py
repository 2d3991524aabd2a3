"""Points beneath kept ones are added where maps hold them, and ghosts go, which few maps hold off a flat surface."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from plane_survey import TILTED, ring
from test_sweep_steep import GSD, HEIGHT, PIXEL, SHAPE, everywhere, masks

from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap
from fields.sweep.overhangs import add_points_beneath, are_off_surface, pixels_beside_steps, without_ghosts

OVER = HEIGHT + 0.4


def added(device, maps: list[np.ndarray], kept, near: bool = True) -> bool:
    """Whether `PIXEL` of the first map is added; ``near`` has a kept point a ground sampling distance from it."""
    if near:
        beside = np.zeros(SHAPE, bool)
        beside[PIXEL[0] + 1, PIXEL[1] + 1] = True
        kept[0] = beside
    stack = ViewStack.build(device, ring(len(maps) - 1), maps, TILTED)
    add_points_beneath(stack, masks(len(maps), m0=True), everywhere(len(maps), True), kept, GSD)
    return bool(kept[0][PIXEL])


def level(height: float) -> np.ndarray:
    return np.full(SHAPE, height, np.float32)


def jumping() -> np.ndarray:
    """Heights far over and far below `HEIGHT` by turns: what lies between is in no pixel."""
    return np.where(np.arange(SHAPE[1]) % 2, level(-1.0), level(-3.0))


def last_map_kept(number: int):
    found = masks(number)
    found[number - 1] = np.ones(SHAPE, bool)
    return found


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([level(HEIGHT)] * 2, True),
        ([level(HEIGHT)], False),
        ([level(HEIGHT)] * 2 + [jumping()], False),
        ([level(HEIGHT)] * 3 + [jumping()], True),
        ([level(HEIGHT)] * 3 + [level(HEIGHT - 0.5)], False),
    ],
)
def test_what_two_maps_hold_is_added_but_not_what_lies_between_heights_or_is_seen_through(device, others, expected):
    maps = [level(HEIGHT), *others, level(OVER)]
    assert added(device, maps, last_map_kept(len(maps))) == expected


@pytest.mark.parametrize(
    ("others", "expected"),
    [
        ([level(HEIGHT)], True),
        ([level(HEIGHT), jumping()], True),
        ([jumping()] * 2, False),
        ([level(HEIGHT), level(HEIGHT - 0.5)], True),
        ([level(HEIGHT), *[level(HEIGHT - 0.5)] * 2], False),
    ],
)
def test_far_from_all_points_one_map_is_enough_unless_more_see_through_it(device, others, expected):
    maps = [level(HEIGHT), *others, level(OVER)]
    assert added(device, maps, last_map_kept(len(maps)), near=False) == expected


def test_without_a_kept_point_above_nothing_is_added(device):
    assert not added(device, [level(HEIGHT)] * 3 + [level(OVER)], masks(4))


def test_where_a_kept_point_is_near_nothing_is_added(device):
    kept = last_map_kept(4)
    kept[1] = np.ones(SHAPE, bool)
    assert not added(device, [level(HEIGHT)] * 3 + [level(OVER)], kept)


def test_beside_a_step_is_what_lies_below_it_within_six_pixels():
    height = np.zeros((3, 30), np.float32)
    height[:, 20:] = 13.0 * GSD
    assert np.flatnonzero(pixels_beside_steps(height, GSD)[1]).tolist() == list(range(14, 20))


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
