"""Heights that other views look through, and places that they show masked: level beds seen by all views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.sweep.block import Block
from fields.sweep.fusion import peers_with_height, remove_free_space_violations
from fields.sweep.maps import HeightMap, trusted
from refract import FlatWater

BED = PlaneBed(TILTED, -2.0)
# Half a metre is a parallax of 10 px.
OVER_M = 0.5
PATCH = np.s_[30:42, 40:56]


def level_maps(water: FlatWater | None, agreeing: int = 4) -> tuple[list, list[HeightMap]]:
    """Cameras, and maps of a level bed that so many views confirm everywhere."""
    cameras = ring(5)
    shape = (cameras[0].height, cameras[0].width)
    level = np.full(shape, -2.0, dtype=np.float32)
    ones = np.ones(shape, dtype=np.float32)
    count = np.full(shape, agreeing, dtype=np.uint8)
    return cameras, [HeightMap(view, level.copy(), ones, count.copy(), 0.0 * ones) for view in range(len(cameras))]


def block_of(device, cameras, water=TILTED) -> Block:
    shape = (cameras[0].height, cameras[0].width)
    return Block(device, cameras, [np.zeros(shape, dtype=np.float32) for _ in cameras], water, -2.0)


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_a_height_that_more_views_look_through_than_confirm_is_confirmed_by_none(device, water):
    cameras, maps = level_maps(water)
    maps[0].height[PATCH] += OVER_M
    maps[0].agreeing[PATCH] = 2
    found = remove_free_space_violations(block_of(device, cameras, water), maps)
    assert (found[0].agreeing[PATCH] == 0).all()
    beside = np.ones(maps[0].height.shape, dtype=bool)
    beside[PATCH] = False
    assert (found[0].agreeing[beside] == 4).all()
    assert all((m.agreeing == 4).all() for m in list(found)[1:])
    assert not trusted(found[0])[PATCH].any()


def test_a_mast_that_more_views_confirm_than_look_through_stays(device):
    cameras, maps = level_maps(TILTED)
    maps[0].height[PATCH] += OVER_M
    maps[0].agreeing[PATCH] = 6
    found = remove_free_space_violations(block_of(device, cameras), maps)
    assert (found[0].agreeing[PATCH] == 6).all()


def test_heights_that_are_not_trusted_contradict_nothing(device):
    cameras, maps = level_maps(TILTED, agreeing=0)
    maps = [replace(m, score=0.5 * m.score) for m in maps]
    maps[0].height[PATCH] += OVER_M
    maps[0].agreeing[PATCH] = 2
    found = remove_free_space_violations(block_of(device, cameras), maps)
    assert (found[0].agreeing[PATCH] == 2).all()


def test_what_hangs_under_the_bed_is_hidden_and_not_looked_through(device):
    cameras, maps = level_maps(TILTED)
    maps[0].height[PATCH] -= OVER_M
    maps[0].agreeing[PATCH] = 2
    found = remove_free_space_violations(block_of(device, cameras), maps)
    assert (found[0].agreeing[PATCH] == 2).all()
    # The other views' bed on the rays of these pixels is looked through by one view, and confirmed by four.
    assert all((m.agreeing == 4).all() for m in list(found)[1:])


def test_views_that_overlap_with_no_other_keep_their_maps(device):
    cameras, maps = level_maps(TILTED)
    found = remove_free_space_violations(block_of(device, cameras), maps[:1])
    assert found[0] is maps[0]


def test_peers_that_show_a_place_masked_have_no_height_there(device):
    cameras, maps = level_maps(TILTED)
    block = block_of(device, cameras)
    whole = next(peers_with_height(block, maps))
    # All peers but one are masked.
    masked = [*maps[:2], *(replace(m, score=-m.score) for m in maps[2:])]
    one = next(peers_with_height(block, masked))
    assert whole.shape == one.shape == maps[0].height.shape
    assert whole.max() == len(cameras) - 1
    assert set(np.unique(one)) == {0.0, 1.0}
    assert (one <= whole).all()
