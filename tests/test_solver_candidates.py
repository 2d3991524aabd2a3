"""Candidates become points where they were solved, have neighbours in space, and no map sees through them."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import SIZE, TILTED, PlaneBed, ring

from fields.image_store import Masks
from fields.solver.candidates import take_candidates
from fields.solver.solver import SolvedMap
from fields.sweep.bed import select_pixels
from fields.sweep.candidates import Selection
from fields.sweep.maps import DepthMap

SHAPE, HEIGHT, GSD = SIZE[::-1], -2.0, 0.015
PATCH, PIXEL, LINE = np.s_[30:42, 40:52], np.s_[30:31, 40:41], np.s_[35:36, 40:52]


def map_of(view: int, height: np.ndarray) -> DepthMap:
    full = [np.full(SHAPE, value, np.float32) for value in (0.9, 0.01)]
    return DepthMap(view, height.astype(np.float32), full[0], np.full(SHAPE, 3, np.uint8), full[1])


def level() -> np.ndarray:
    return np.full(SHAPE, HEIGHT, np.float32)


def mask_of(part=None, value: bool = True) -> np.ndarray:
    mask = np.zeros(SHAPE, bool)
    if part is not None:
        mask[part] = value
    return mask


def masks(*each: np.ndarray) -> Masks:
    found = Masks([SHAPE] * len(each))
    for number, mask in enumerate(each):
        found[number] = mask
    return found


def solved(m: DepthMap, mask: np.ndarray) -> SolvedMap:
    pixels = np.flatnonzero(mask)
    return SolvedMap(pixels, m.height.ravel()[pixels], np.full(len(pixels), 0.01, np.float32))


@pytest.fixture(scope="module")
def block(device):
    return PlaneBed(TILTED, -2.0).block(device, ring(3))


def taken(block, above_m: float, candidates: np.ndarray, known: np.ndarray, part=PATCH) -> Masks:
    """What becomes of the candidates of map 1, a part of which lies above the level bed of all maps."""
    height = level()
    height[part] += above_m
    maps = [map_of(0, level()), map_of(1, height), map_of(2, level())]
    everything = masks(*[mask_of(np.s_[:])] * 3)
    chosen = Selection(masks(*[mask_of()] * 3), masks(mask_of(), candidates, mask_of()), everything)
    return take_candidates(block, maps, [solved(m, known) for m in maps], chosen, GSD)


def test_solved_candidates_that_are_a_surface_become_points_once_per_ground_sampling_distance(block):
    found = taken(block, 0.02, mask_of(PATCH), mask_of(np.s_[:]))
    assert not found[0].any()
    # A pixel covers 1.5 cm of level ground, a little more or less than the distance.
    assert 0.3 * 144 < found[1].sum() <= 144
    assert not (found[1] & ~mask_of(PATCH)).any()


@pytest.mark.parametrize(
    ("above_m", "part", "known"),
    [(0.02, PATCH, None), (0.5, PATCH, np.s_[:]), (0.02, PIXEL, np.s_[:]), (0.02, LINE, np.s_[:])],
    ids=["not solved", "seen through", "alone in space", "alone in its map"],
)
def test_other_candidates_do_not(block, above_m, part, known):
    raised = LINE if part is LINE else PATCH
    assert not taken(block, above_m, mask_of(part), mask_of(known), raised)[1].any()


def test_without_a_solver_nothing_changes(block):
    maps = [map_of(view, level()) for view in range(3)]
    chosen = Selection(masks(*[mask_of(PATCH)] * 3), masks(*[mask_of(np.s_[:])] * 3), masks(*[mask_of(np.s_[:])] * 3))
    found = take_candidates(block, maps, [SolvedMap.empty() for _ in maps], chosen, GSD)
    for keep in found:
        np.testing.assert_array_equal(keep, mask_of(PATCH))
    assert len(take_candidates(block, [], [], Selection(*[Masks([])] * 3), GSD)) == 0


@pytest.mark.parametrize(("agreeing", "is_candidate"), [(1, True), (0, False)])
def test_what_one_view_confirms_beside_a_step_away_from_all_points_is_a_candidate(block, agreeing, is_candidate):
    tolerance = block.agreement_tolerance(0, [1, 2, 3], HEIGHT)
    height, right = level(), np.s_[:, 40:]
    # Too high to be claimed, and too low for others to see through it.
    height[right] += 1.5 * tolerance
    height[30:42, 52:60] += 20.0 * tolerance
    doubtful = map_of(1, height)
    doubtful.agreeing[right], doubtful.score[right] = agreeing, 0.5
    chosen = select_pixels(block, [map_of(0, level()), doubtful, map_of(2, level())], 1.1 * tolerance)
    found = chosen.candidates[1]
    beside = found[32:40, 48:50]
    assert beside.all() == beside.any() == is_candidate
    assert not found[:, :30].any()
    assert not found[:, 75:].any()
    assert not (found & chosen.kept[1]).any()
    np.testing.assert_array_equal(chosen.together()[1], found | chosen.kept[1])
