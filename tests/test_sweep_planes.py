"""Planes through known heights: how the bed goes on where a view does not know it, and where it is steep."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import TILTED, PlaneBed, ring

from fields.sweep import fusion
from fields.sweep.images import SIDE_PX, extrapolate_planes, slope_of, steep_and_wall_pixels
from fields.sweep.maps import HeightMap

# Of heights of some metres in float32.
ROUNDING_M = 2e-6
TOLERANCE_M = 0.02
# More rows than are worked out together.
SHAPE = (150, 40)


@pytest.fixture
def slope() -> np.ndarray:
    """A bed that falls by three centimetres from row to row."""
    rows, columns = np.indices(SHAPE)
    return (-2.0 - 0.03 * rows + 0.01 * columns).astype(np.float32)


def test_unknown_heights_on_a_slope_are_those_of_the_slope(slope, rng):
    known = rng.random(SHAPE) < 0.6
    wrong = np.where(known, slope, slope + rng.normal(0.0, 0.5, SHAPE)).astype(np.float32)
    np.testing.assert_allclose(extrapolate_planes(wrong, known, TOLERANCE_M), slope, atol=ROUNDING_M)


def test_known_heights_stay_as_they_are(slope, rng):
    known, noisy = rng.random(SHAPE) < 0.6, (slope + rng.normal(0.0, 0.005, SHAPE)).astype(np.float32)
    np.testing.assert_array_equal(extrapolate_planes(noisy, known, TOLERANCE_M)[known], noisy[known])


def test_the_plane_is_that_of_least_squares(slope, rng):
    known, noisy = rng.random(SHAPE) < 0.5, (slope + rng.normal(0.0, 0.005, SHAPE)).astype(np.float32)
    known[64, 20] = False
    found, half = extrapolate_planes(noisy, known, TOLERANCE_M), SIDE_PX // 2
    rows, columns = np.nonzero(known[64 - half : 64 + half + 1, 20 - half : 20 + half + 1])
    ones = np.stack([np.ones(len(rows)), rows - half, columns - half], axis=-1)
    expected = np.linalg.lstsq(ones, noisy[64 - half + rows, 20 - half + columns].astype(np.float64))[0][0]
    assert found[64, 20] == pytest.approx(expected, abs=ROUNDING_M)


def test_beside_a_step_nothing_is_changed(slope, rng):
    known, stepped = rng.random(SHAPE) < 0.6, slope.copy()
    stepped[:, 20:] += 0.5
    found, beside = extrapolate_planes(stepped, known, TOLERANCE_M), slice(18, 23)
    np.testing.assert_array_equal(found[:, beside], stepped[:, beside])


@pytest.mark.parametrize("where", [np.s_[75:76, 20:21], np.s_[75:76, :], np.s_[:, 20:21], np.s_[:0]])
def test_a_few_known_heights_or_a_line_of_them_are_no_plane(slope, where):
    known = np.zeros(SHAPE, dtype=bool)
    known[where] = True
    np.testing.assert_array_equal(extrapolate_planes(slope, known, TOLERANCE_M), slope)


def test_heights_that_are_not_trusted_begin_the_next_pass_on_the_plane_of_those_around(device):
    bed, cameras = PlaneBed(TILTED, -2.0, slope=0.1), ring(3)
    block = bed.block(device, cameras, None)
    off = np.s_[30:37, 40:47]

    def fused(is_intermediate: bool) -> np.ndarray:
        maps = {}
        for view, camera in enumerate(cameras):
            height = bed.true_height(camera).astype(np.float32)
            nobody = np.zeros(height.shape, dtype=np.uint8)
            if view == 0:
                height[off] += 1.0
            m = HeightMap(view, height, np.ones(height.shape, np.float16), nobody, nobody.astype(np.float16))
            maps[view] = m
        peers = {view: fusion.ComparedViews([other for other in maps if other != view]) for view in maps}
        fused = fusion.fuse(block, maps, 1.0, peers, is_intermediate=is_intermediate)[0]
        return fused.height[off]

    truth = bed.true_height(cameras[0])[off]
    # True heights of a tilted plane are those of one in the image but for perspective.
    np.testing.assert_allclose(fused(is_intermediate=True), truth, atol=1e-3)
    assert (np.abs(fused(is_intermediate=False) - truth) > 0.5).any()


@pytest.mark.parametrize("height", [0.0, -300.0])
def test_the_slope_of_a_plane_is_its_rise_from_pixel_to_pixel(height):
    rows, columns = np.mgrid[:20, :30]
    plane = (height + 0.03 * rows - 0.04 * columns).astype(np.float32)
    inner = np.s_[1:-1, 1:-1]
    np.testing.assert_allclose(slope_of(plane)[inner], 0.05, atol=1e-4)


def test_a_wall_is_steep_and_plane_and_an_edge_is_not_plane():
    wall = np.repeat((0.3 * np.clip(np.arange(30) - 10, 0, 9)).astype(np.float32)[None], 20, axis=0)
    found = steep_and_wall_pixels(wall, 0.1)[1][10]
    assert found[12:18].all()
    assert not found[:10].any()
    assert not found[21:].any()
    edge = np.where(np.arange(30) < 15, 0.0, 2.0).astype(np.float32)[None].repeat(20, axis=0)
    steep, walls = steep_and_wall_pixels(edge, 0.1)
    assert steep[10, 14:16].all()
    assert not steep[10, :13].any()
    assert not walls.any()
