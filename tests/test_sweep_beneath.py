"""Pixels beneath kept points become points themselves where maps hold them."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import TILTED, ring
from test_sweep_steep import GSD, HEIGHT, PIXEL, SHAPE, everywhere, masks

from fields.sweep.kernels.stack import ViewStack
from fields.sweep.overhangs import add_points_beneath, pixels_beside_steps

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
