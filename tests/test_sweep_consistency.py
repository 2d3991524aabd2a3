"""Heights of maps that agree, and photographs that show the bed of the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, look, ring
from scipy.spatial.transform import Rotation

from fields.sweep import fusion
from fields.sweep.block import Block
from fields.sweep.kernels.arrays import run_job
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap
from fields.sweep.photo_consistency import photo_consistency

OWN, TOLERANCE = -2.0, 0.05
# Heights of a few metres in float32; their mean is exact to a few roundings.
HEIGHT_M = 1e-6


def level_maps(device, heights, water=TILTED) -> ViewStack:
    """Height maps, each of one height over the water plane, of a ring of cameras."""
    cameras = ring(len(heights) - 1)
    shape = (cameras[0].height, cameras[0].width)
    return ViewStack.build(device, cameras, [np.full(shape, h, np.float32) for h in heights], water)


def agreement(stack: ViewStack, view: int, peers: list[int], tolerance: float):
    """What `fields.sweep.fusion.agreement` finds."""
    return run_job(stack.device, fusion.agreement(stack, view, peers, tolerance))


def seen_by(stack: ViewStack, peer: int, height: float = OWN) -> np.ndarray:
    """Which pixels (height, width) of view 0 a peer sees, by the exact projection; margins of 0.01 px are NaN."""
    cameras, water = stack.cameras, stack.water
    points = cameras[0].paths(cameras[0].pixel_centres(), water).at_height(height, water)
    uv = cameras[peer].project(points, water)
    margin = np.minimum(uv - 0.5, np.array([stack.width - 0.5, stack.height - 0.5]) - uv).min(axis=-1)
    return np.where(np.abs(margin) < 0.01, np.nan, margin > 0.0)


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
def test_equal_heights_agree_in_every_peer_that_sees_them(device, water):
    stack = level_maps(device, [OWN] * 4, water)
    agreeing, fused, spread = agreement(stack, 0, [1, 2, 3], TOLERANCE)
    expected = sum(seen_by(stack, peer) for peer in (1, 2, 3))
    clear = np.isfinite(expected)
    np.testing.assert_array_equal(agreeing[clear], expected[clear])
    assert (agreeing == 3).any()
    assert (agreeing < 3).any()
    assert agreeing.dtype == (np.uint8)
    np.testing.assert_array_equal(fused, np.float32(OWN))
    np.testing.assert_array_equal(spread, 0.0)


def test_the_mean_and_the_spread_are_those_of_the_heights_that_agree(device):
    offsets = [0.0, 0.03, -0.01, 0.5]
    stack = level_maps(device, [OWN + o for o in offsets])
    agreeing, fused, spread = agreement(stack, 0, [1, 2, 3], TOLERANCE)
    two = agreeing == 2
    assert two.mean() > 0.4
    assert agreeing.max() == 2  # the third stands half a metre off
    np.testing.assert_allclose(fused[two], OWN + np.mean(offsets[:3]), atol=HEIGHT_M)
    np.testing.assert_allclose(spread[two], np.std(offsets[:3]), atol=HEIGHT_M)
    only_first = (agreeing == 1) & (seen_by(stack, 1) == 1.0)
    assert only_first.any()
    np.testing.assert_allclose(fused[only_first], OWN + 0.015, atol=HEIGHT_M)
    np.testing.assert_allclose(spread[only_first], 0.015, atol=HEIGHT_M)


def test_heights_farther_apart_than_the_tolerance_do_not_agree(device):
    stack = level_maps(device, [OWN, OWN + 1.1 * TOLERANCE, OWN - 1.1 * TOLERANCE])
    agreeing, fused, spread = agreement(stack, 0, [1, 2], TOLERANCE)
    assert not agreeing.any()
    np.testing.assert_array_equal(fused, np.float32(OWN))
    np.testing.assert_array_equal(spread, 0.0)
    assert agreement(stack, 0, [1, 2], 1.2 * TOLERANCE)[0].max() == 2


def test_a_height_that_is_not_there_confirms_nothing_and_is_confirmed_by_none(device):
    stack = level_maps(device, [OWN, np.nan, OWN])
    agreeing, fused, _ = agreement(stack, 0, [1, 2], TOLERANCE)
    clear = np.isfinite(seen_by(stack, 2))
    np.testing.assert_array_equal(agreeing[clear], seen_by(stack, 2)[clear])
    np.testing.assert_array_equal(fused, np.float32(OWN))
    agreeing, fused, _ = agreement(stack, 1, [0, 2], TOLERANCE)
    assert not agreeing.any()
    assert np.isnan(fused).all()


def test_a_height_on_the_other_side_of_the_surface_is_compared_like_any_other(device):
    stack = level_maps(device, [0.01, -0.01, -0.01])
    agreeing, fused, _ = agreement(stack, 0, [1, 2], TOLERANCE)
    two = agreeing == 2
    assert two.mean() > 0.1
    np.testing.assert_allclose(fused[two], -0.01 / 3.0, atol=HEIGHT_M)


WRONG = 3


def turned(camera, degrees: float, axis: str):
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return replace(camera, cam_from_local=turn @ camera.cam_from_local)


POSES = {
    "upside down": lambda camera: turned(camera, 180.0, "x"),
    "a quarter turn": lambda camera: turned(camera, 90.0, "z"),
    "beside its place": lambda camera: replace(camera, centre=np.add(camera.centre, (0.5, 0.3, 0.0))),
    "of another place": lambda camera: look((40.0, 0.0, 10.0), (40.0, 0.0, -2.0)),
}


@pytest.mark.parametrize("water", [TILTED, None], ids=["wet", "dry"])
@pytest.mark.parametrize("wrong", POSES)
def test_a_photograph_with_a_wrong_pose_does_not_show_the_bed_of_the_others(device, water, wrong):
    bed, cameras = PlaneBed(water, -2.0), ring(6)
    images = [bed.photograph(camera) for camera in cameras]
    maps = []
    for view in (0, 1, 2):
        height = bed.true_height(cameras[view]).astype(np.float32)
        ones = np.ones_like(height)
        maps.append(HeightMap(view, height, ones, np.full(height.shape, 4, np.uint8), 0.0 * ones))
    cameras[WRONG] = POSES[wrong](cameras[WRONG])
    found = photo_consistency(Block(device, cameras, images, water, -2.0), maps)
    right = [each.correlation for view, each in enumerate(found) if view != WRONG]
    # Noise-free photographs of one plane.
    assert min(right) > 0.9
    one = found[WRONG]
    assert one.num_points == 0 or one.correlation is None or one.correlation < 0.3


def test_without_maps_nothing_is_known(device):
    bed, cameras = PlaneBed(None, -2.0), ring(3)
    images = [bed.photograph(camera) for camera in cameras]
    assert all(each.correlation is None for each in photo_consistency(Block(device, cameras, images, None, -2.0), []))


def test_windows_give_as_many_points_as_their_share_of_the_photograph(device):
    bed, cameras = PlaneBed(None, -2.0), ring(6)
    images = [bed.photograph(camera) for camera in cameras]
    height = bed.true_height(cameras[0]).astype(np.float32)
    ones = np.ones_like(height)
    maps = [HeightMap(0, height, ones, np.full(height.shape, 4, np.uint8), 0.0 * ones)]
    block = Block(device, cameras, images, None, -2.0)
    larger = replace(cameras[0], width=2 * cameras[0].width, height=2 * cameras[0].height)
    # All photographs of the ring show the same place.
    (whole, *_), (window, *_) = (
        [each.num_points for each in photo_consistency(block, maps, of)[1:]] for of in (cameras[0], larger)
    )
    assert 0.0 < window < 0.35 * whole
