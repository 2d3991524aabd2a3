"""Heights that other views look through, and places that they show masked: level beds seen by all views."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.sweep.block import Block
from fields.sweep.fusion import num_comparable, remove_free_space_violations
from fields.sweep.maps import HeightMap, height_std, trusted
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


def block_of(device, cameras, water=TILTED, holes: dict[int, tuple[slice, slice]] | None = None) -> Block:
    """The block, with a part of some photographs masked."""
    images = [np.zeros((camera.height, camera.width), dtype=np.float32) for camera in cameras]
    for view, hole in (holes or {}).items():
        images[view][hole] = np.nan
    return Block(device, cameras, images, water, -2.0)


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


@pytest.mark.parametrize(
    ("off", "agreeing", "of_others", "score"),
    [(OVER_M, 6, 4, 1.0), (OVER_M, 2, 0, 0.5), (-OVER_M, 2, 4, 1.0)],
    ids=["a mast that more views confirm", "others that are not trusted", "under the bed it is hidden"],
)
def test_a_height_that_few_views_look_through_stays(device, off, agreeing, of_others, score):
    cameras, maps = level_maps(TILTED, of_others)
    maps = [replace(m, score=score * m.score) for m in maps]
    maps[0].height[PATCH] += off
    maps[0].agreeing[PATCH] = agreeing
    found = list(remove_free_space_violations(block_of(device, cameras), maps))
    assert (found[0].agreeing[PATCH] == agreeing).all()
    # The other views' bed on the rays of these pixels is looked through by one view at most.
    assert off > 0.0 or all((m.agreeing == 4).all() for m in found[1:])


def test_views_that_overlap_with_no_other_keep_their_maps(device):
    cameras, maps = level_maps(TILTED)
    found = remove_free_space_violations(block_of(device, cameras), maps[:1])
    assert found[0] is maps[0]


def test_photographs_that_are_masked_at_a_place_are_not_comparable_there(device):
    cameras, maps = level_maps(TILTED)
    assert list(num_comparable(block_of(device, cameras), maps)) == [None] * len(cameras)
    found = next(
        num_comparable(block_of(device, cameras, holes=dict.fromkeys(range(2, len(cameras)), np.s_[:, :])), maps)
    )
    assert found.shape == maps[0].height.shape
    assert set(np.unique(found)) == {0.0, 1.0, np.inf}
    # Where none of the photographs that show a place is masked there, all of them are comparable.
    found = next(num_comparable(block_of(device, cameras, holes={4: np.s_[:1, :1]}), maps))
    assert np.mean(np.isfinite(found)) < 0.01


def test_a_masked_pixel_changes_the_std_only_at_the_place_that_it_shows(device):
    cameras, maps = level_maps(TILTED)
    # One other photograph agrees in the patch; the others match nothing there, and are neither masked nor white.
    maps[0].agreeing[PATCH], maps[0].spread[:] = 1, 0.01
    maps = [*maps[:2], *(replace(m, score=0.0 * m.score) for m in maps[2:])]

    def std(holes: dict[int, tuple[slice, slice]]) -> np.ndarray:
        (found, *_) = num_comparable(block_of(device, cameras, holes=holes), maps)
        return height_std(maps[0].height, maps[0].agreeing, maps[0].spread, 0.03, found)

    corner = np.s_[:1, :1]
    whole, far = std({}), std({4: corner})
    assert (far[PATCH] == whole[PATCH]).all()
    assert np.mean(far != whole) < 0.05
    assert np.median(std(dict.fromkeys(range(2, len(cameras)), np.s_[:, :]))[PATCH] / whole[PATCH]) < 0.85
