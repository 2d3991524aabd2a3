"""Passes that refine only what becomes a point: which pixels these are, and that they are refined as all would be."""

import numpy as np
import pytest
from plane_survey import SIZE, TILTED, PlaneBed, ring

from fields.sweep.bed import unique_pixels
from fields.sweep.block import Block
from fields.sweep.fusion import agreement
from fields.sweep.kernels.arrays import run_job
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap, trusted
from fields.sweep.matching import Pass, before_solver
from fields.sweep.sweep import predict_selected_pixels, sweep
from fields.sweep.tiles import PART_SIDE_PX, ImageTiles
from fields.sweep.view_pass import SweepSettings, match_pass, refine_part, view_passes

BED = PlaneBed(TILTED, -2.0, slope=0.1)
REFINING = Pass(1.0, 1, 5, 0.25, 6, True, points_only=True)
# Heights are off by a quarter of a pixel of parallax before they are refined [m].
OFF_M = 4e-3
# Rounding of float32, of heights and of grey levels, moves the parabola through three scores by less [m].
SAME_M = 2e-4


@pytest.fixture(scope="module")
def block(device) -> Block:
    return BED.block(device, ring(6))


def map_of(block: Block, view: int, off: float = 0.0) -> HeightMap:
    """The true heights of a view, or some that are off [m], confirmed by three views."""
    height = (BED.true_height(block.cameras[view]) + off).astype(np.float32)
    ones = np.ones(height.shape, np.float16)
    return HeightMap(view, height, ones, np.full(height.shape, 3, np.uint8), 0 * ones)


def larger(part: np.ndarray) -> np.ndarray:
    """A mask of a quarter of the size at the size of the image."""
    return part.repeat(4, axis=0).repeat(4, axis=1)[: SIZE[1], : SIZE[0]]


def test_nearly_all_that_becomes_a_point_is_predicted_and_most_of_the_rest_is_left_out(block):
    maps = {view: map_of(block, view) for view in range(7)}
    wanted = predict_selected_pixels(block, maps)
    kept = unique_pixels(block, list(maps.values()), gsd=0.015)
    points = sum(int(each.sum()) for each in kept)
    predicted = sum(int((keep & larger(wanted[view])).sum()) for view, keep in enumerate(kept))
    assert predicted > 0.98 * points
    gather = sum(int(part.sum()) for part in wanted.values()) / sum(part.size for part in wanted.values())
    share = points / (7 * SIZE[0] * SIZE[1])
    assert share < gather < share + 0.25


def test_a_place_at_another_height_than_steeper_views_have_becomes_a_point(block):
    maps = {view: map_of(block, view) for view in range(7)}
    order = sorted(maps, key=lambda view: block.cameras[view].cam_from_local[2][2])
    least = maps[order[-1]]
    middle = np.s_[SIZE[1] // 2 - 8 : SIZE[1] // 2 + 8, SIZE[0] // 2 - 8 : SIZE[0] // 2 + 8]
    assert not larger(predict_selected_pixels(block, maps)[least.view])[middle].any()
    least.height[middle] += 1.0
    assert larger(predict_selected_pixels(block, maps)[least.view])[middle].all()


def test_what_nothing_confirms_becomes_no_point(block):
    maps = {view: map_of(block, view) for view in range(7)}
    maps[0].agreeing[:] = 0
    wanted = predict_selected_pixels(block, maps)
    assert not wanted[0].any()
    assert any(part.any() for part in wanted.values())


def test_a_part_is_refined_as_the_whole_view_is_and_the_rest_stays(block):
    before = map_of(block, 0, OFF_M)
    (of_view,) = view_passes(block, [0], REFINING, None)
    whole = run_job(block.device, match_pass(block, REFINING, of_view, SweepSettings((-3.0, -1.0)), before, 0)).map
    part = np.zeros((SIZE[1] // 4, SIZE[0] // 4), dtype=bool)
    part[10:14, 12:20] = True
    matched = run_job(block.device, refine_part(block, REFINING, of_view, before, part))
    height, complete = matched.map.height, whole.height
    mask = np.zeros(height.size, dtype=bool)
    mask[matched.refined_pixels] = True
    assert mask.reshape(height.shape)[larger(part)].all()
    np.testing.assert_array_equal(height.ravel()[~mask], before.height.ravel()[~mask])
    off = np.abs(height - complete).ravel()[mask]
    # Where two hypotheses score alike, rounding may decide for the other.
    assert np.mean(off < SAME_M) > 0.99
    assert np.median(np.abs(height - BED.true_height(block.cameras[0])).ravel()[mask]) < 0.5 * OFF_M


def test_what_is_left_out_of_a_photograph_scores_nothing_in_a_part_of_it_either(device):
    hole = np.s_[44:50, 60:66]
    photographs = [BED.photograph(camera) for camera in ring(6)]
    photographs[0][hole] = np.nan
    block = BED.block(device, ring(6), photographs)
    part = np.ones((SIZE[1] // 4, SIZE[0] // 4), dtype=bool)
    (of_view,) = view_passes(block, [0], REFINING, None)
    score = run_job(device, refine_part(block, REFINING, of_view, map_of(block, 0, OFF_M), part)).map.score
    assert (score[hole] == -1.0).all()
    assert (score[4:40, 4:40] > 0.5).mean() > 0.9


def test_images_smaller_than_a_tile_have_no_parts(block):
    assert SIZE[1] * 0.25 < PART_SIDE_PX < SIZE[1]
    cameras = [camera.scaled(0.25) for camera in ring(6)]
    small = BED.block(block.device, cameras)
    assert predict_selected_pixels(small, {view: map_of(small, view) for view in range(7)}) == {}


def test_some_pixels_agree_as_they_do_among_all(block):
    maps = [map_of(block, view, 0.001 * view) for view in range(7)]
    stack = ViewStack.build(block.device, block.cameras, [m.height for m in maps], TILTED)
    whole = run_job(block.device, agreement(stack, 0, [1, 2, 3], 0.05))
    pixels = np.arange(1000, 3000, 7)
    part = run_job(block.device, agreement(stack, 0, [1, 2, 3], 0.05, pixels))
    for few, every in zip(part, whole, strict=True):
        np.testing.assert_allclose(few, every.ravel()[pixels], rtol=0.0, atol=1e-6)


def test_tiles_over_a_part_hold_all_of_it(block):
    random = np.random.default_rng(3)
    part = random.random((SIZE[1] // 4, SIZE[0] // 4)) < 0.02
    tiles = ImageTiles.over(part, SIZE[::-1], 28, 2, 5)
    assert tiles.wanted.shape == SIZE[::-1]
    assert tiles.wanted[larger(part)].all()
    assert len(tiles.place) == len(np.unique(tiles.place, axis=0))


def test_points_of_a_sweep_that_refines_them_alone_are_as_near_to_the_bed(device):
    block = BED.block(device, ring(6))
    truth = BED.true_height(block.cameras[0])
    bound = (float(truth.min()) - 0.3, float(truth.max()) + 0.4)
    passes = (Pass(0.5, 2, None, 0.5, 6, False), Pass(1.0, 2, 7, 0.4, 6, True), Pass(1.0, 1, 3, 0.25, 6, True))
    errors = []
    for chosen in (passes, before_solver(passes)):
        maps = sweep(block, list(range(7)), SweepSettings(bound, chosen), lambda share: None)
        kept = unique_pixels(block, maps, gsd=0.015)
        off = [
            np.abs(m.height - BED.true_height(block.cameras[m.view]))[keep & trusted(m)]
            for m, keep in zip(maps, kept, strict=True)
        ]
        errors.append(np.concatenate(off))
    every, points = errors
    assert len(points) > 0.97 * len(every)
    assert np.median(points) < 1.5 * np.median(every)
