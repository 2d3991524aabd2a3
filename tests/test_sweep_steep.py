"""Steep pixels, gaps and points beneath others: kept or dropped by the votes of height maps."""

from types import SimpleNamespace

import numpy as np
import pytest
from plane_survey import SIZE, TILTED, ring

from fields.image_store import Masks
from fields.sweep import map_points
from fields.sweep.kernels.arrays import floats
from fields.sweep.kernels.rays import vote_on_points
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap

SHAPE, HEIGHT, GSD = SIZE[::-1], -2.0, 0.02
PIXEL = SHAPE[0] // 2, SHAPE[1] // 2


def masks(number: int, **of_maps) -> Masks:
    """Empty ones, but at `PIXEL` of the maps that are named (`m0` the first)."""
    found = Masks([SHAPE] * number)
    for name, value in of_maps.items():
        mask = np.zeros(SHAPE, bool)
        mask[PIXEL] = value
        found[int(name[1:])] = mask
    return found


def everywhere(number: int, value: bool) -> Masks:
    found = Masks([SHAPE] * number)
    for index in range(number):
        found[index] = np.full(SHAPE, value)
    return found


def level_stack(device, heights: list[float]) -> ViewStack:
    """Maps of one height each, the first over the middle and the others around it."""
    cameras = ring(len(heights) - 1)
    return ViewStack.build(device, cameras, [np.full(SHAPE, h, np.float32) for h in heights], TILTED)


def settled(stack: ViewStack, steep: Masks, fit: Masks, kept: Masks, sure: bool = True) -> list[bool]:
    """Whether `PIXEL` of each map is kept in the end."""
    map_points.filter_steep_pixels(stack, map_points.SteepPixels(steep, fit, everywhere(len(kept), sure)), kept, GSD)
    return [bool(keep[PIXEL]) for keep in kept]


@pytest.mark.parametrize(("others", "sure", "stays"), [(-2.5, True, False), (-2.5, False, True), (-2.01, True, True)])
def test_a_steep_pixel_goes_if_more_maps_are_sure_to_look_through_it_than_have_it(device, others, sure, stays):
    stack = level_stack(device, [HEIGHT, *[others] * 3])
    found = settled(stack, masks(4, m0=True), masks(4), masks(4, m0=True), sure)
    assert found == [stays, False, False, False]


@pytest.mark.parametrize(
    ("others", "added"),
    [([HEIGHT] * 4, True), ([HEIGHT] * 3, False), ([HEIGHT] * 4 + [-2.5], True), ([HEIGHT] * 4 + [-2.5] * 2, False)],
)
def test_a_pixel_fills_a_gap_if_four_maps_have_it_and_few_look_through_it(device, others, added):
    number = 1 + len(others)
    found = settled(level_stack(device, [HEIGHT, *others]), masks(number), masks(number, m0=True), masks(number))
    assert found[0] == added


@pytest.mark.parametrize(("columns", "added"), [(1, False), (4, True)])
def test_where_a_point_is_near_nothing_is_added(device, columns, added):
    # A pixel covers 1.5 cm.
    stack, kept = level_stack(device, [HEIGHT] * 5), masks(5)
    beside = np.zeros(SHAPE, bool)
    beside[PIXEL[0], PIXEL[1] + columns] = True
    kept[0] = beside
    assert settled(stack, masks(5), masks(5, m0=True), kept)[0] == added


def test_of_pixels_nearer_to_each_other_than_a_gap_one_is_added(device):
    stack, fit, kept = level_stack(device, [HEIGHT] * 5), masks(5), masks(5)
    row = np.zeros(SHAPE, bool)
    row[PIXEL[0], PIXEL[1] + np.array([0, 1, 4])] = True
    fit[0] = row
    settled(stack, masks(5), fit, kept)
    assert kept[0][row].tolist() == [True, False, True]


def test_maps_span_what_lies_between_heights_match_what_is_at_one_and_see_through_what_lies_above(device, rng):
    stack = level_stack(device, [HEIGHT] * 3)
    heights = rng.uniform(-2.1, -1.9, SHAPE).astype(np.float32)
    stack = ViewStack.build(device, stack.cameras, [*stack.images[:2], heights], TILTED)
    sure = rng.random(SHAPE) < 0.9
    points = np.stack([*rng.uniform(-0.3, 0.3, (2, 400)), rng.uniform(-2.2, -1.8, 400)])
    found = vote_on_points(stack, tuple(floats(device, each) for each in points), 2, GSD, sure)
    local = stack.kernel_water.origin + points.T @ stack.kernel_water.from_local
    u, v = (stack.cameras[2].project(local, TILTED) - 0.5).T
    # What rounds to another pixel is not asked.
    clear = (np.abs(u - np.round(u)) > 1e-2) & (np.abs(v - np.round(v)) > 1e-2)
    column, row = np.floor(u).astype(int), np.floor(v).astype(int)
    four, known = (np.stack([a[row + i, column + j] for i in (0, 1) for j in (0, 1)]) for a in (heights, sure))
    above, below = points[2] - four.max(axis=0), four.min(axis=0) - points[2]
    clear &= (np.abs(above - GSD) > 1e-4) & (np.abs(below - GSD) > 1e-4)
    assert clear.sum() > 300
    np.testing.assert_array_equal(found[0][clear], ((above < GSD) & (below < GSD))[clear])
    np.testing.assert_array_equal(found[1][clear], ((above > GSD) & known.all(axis=0))[clear])
    off = np.abs(four - points[2])
    clear &= (np.abs(off - GSD) > 1e-4).all(axis=0)
    np.testing.assert_array_equal(found[2][clear], ((off < GSD) & known).any(axis=0)[clear])


def test_points_spread_out_are_those_that_taking_turns_takes(rng):
    points = rng.random((300, 3))
    gather = []
    for index, point in enumerate(points):
        if all(np.linalg.norm(point - points[other]) > 0.15 for other in gather):
            gather.append(index)
    np.testing.assert_array_equal(np.flatnonzero(map_points.thin_out(points, 0.15)), gather)
    assert map_points.thin_out(points[:0], 0.15).shape == (0,)


OVER = HEIGHT + 0.4


def added(device, maps: list[np.ndarray], kept, near: bool = True) -> bool:
    """Whether `PIXEL` of the first map is added; ``near`` has a kept point a ground sampling distance from it."""
    if near:
        beside = np.zeros(SHAPE, bool)
        beside[PIXEL[0] + 1, PIXEL[1] + 1] = True
        kept[0] = beside
    stack = ViewStack.build(device, ring(len(maps) - 1), maps, TILTED)
    map_points.add_points_beneath(stack, masks(len(maps), m0=True), everywhere(len(maps), True), kept, GSD)
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


def test_beside_a_step_is_what_lies_below_it_within_six_pixels():
    height = np.zeros((3, 30), np.float32)
    height[:, 20:] = 13.0 * GSD
    assert np.flatnonzero(map_points.pixels_beside_steps(height, GSD)[1]).tolist() == list(range(14, 20))


# A level square of 13 points on each side, one ground sampling distance apart, and its middle.
SIDE = np.arange(13.0)
SURFACE = np.stack([*(each.ravel() for each in np.meshgrid(SIDE, SIDE)), np.zeros(13 * 13)], axis=-1)
MIDDLE = 6.0, 6.0


def is_off(place, matching: int = 0, surface: np.ndarray = SURFACE, matching_about: int = 10) -> bool:
    return bool(
        map_points.are_off_surface(
            np.array([place]), np.array([matching]), surface, np.full(len(surface), matching_about)
        )[0]
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
    left = map_points.without_ghosts(block, maps, kept, GSD)
    assert bool(left[0][PIXEL]) == stays
    assert left[1].all()
    assert left[len(maps) - 1].all()
    assert kept[0][PIXEL]
