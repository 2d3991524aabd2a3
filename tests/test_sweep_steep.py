"""What is steep in height maps is judged in space: by the maps that look at it or through it, and by its gaps."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import SIZE, TILTED, ring

from fields.image_store import Masks
from fields.sweep.kernels.arrays import floats
from fields.sweep.kernels.backend import kernels
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.planes import SteepPixels, filter_steep_pixels, thin_out

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
    filter_steep_pixels(stack, SteepPixels(steep, fit, everywhere(len(kept), sure)), kept, GSD)
    return [bool(keep[PIXEL]) for keep in kept]


@pytest.mark.parametrize(("others", "sure", "stays"), [(-2.5, True, False), (-2.5, False, True), (-2.01, True, True)])
def test_a_steep_pixel_goes_if_more_maps_are_sure_to_look_through_it_than_have_it(device, others, sure, stays):
    stack = level_stack(device, [HEIGHT, *[others] * 3])
    found = settled(stack, masks(4, m0=True), masks(4), masks(4, m0=True), sure)
    assert found == [stays, False, False, False]


def test_a_pixel_that_is_not_steep_stays_whatever_looks_through_it(device):
    stack = level_stack(device, [HEIGHT, *[-2.5] * 3])
    assert settled(stack, masks(4), masks(4), masks(4, m0=True)) == [True, False, False, False]


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
    found = kernels(device).vote_on_points(stack, tuple(floats(device, each) for each in points), 2, GSD, sure)
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
    np.testing.assert_array_equal(np.flatnonzero(thin_out(points, 0.15)), gather)
    assert thin_out(points[:0], 0.15).shape == (0,)
