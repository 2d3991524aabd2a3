"""Agreement of height maps: level beds at known offsets, seen through tilted water and dry."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import TILTED, found_by, ring

from fields.sweep import fusion
from fields.sweep.kernels.stack import ViewStack

OWN, TOLERANCE = -2.0, 0.05
# Heights of a few metres in float32; their mean is exact to a few roundings.
HEIGHT_M = 1e-6


def level_maps(device, heights, water=TILTED) -> ViewStack:
    """Height maps, each of one height over the water plane, of a ring of cameras."""
    cameras = ring(len(heights) - 1)
    shape = (cameras[0].height, cameras[0].width)
    return ViewStack.build(device, cameras, [np.full(shape, h, np.float32) for h in heights], water)


def agreement(stack: ViewStack, view: int, peers: list[int], tolerance: float):
    """`fields.sweep.fusion.agreement` on the host."""
    return found_by(stack.device, fusion.agreement(stack, view, peers, tolerance))


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
    assert agreeing.dtype == (np.float32 if device.has_own_memory else np.uint8)
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
