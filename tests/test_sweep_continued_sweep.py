"""A sweep that goes on from the heights of a smaller one, in some of its views."""

from __future__ import annotations

import numpy as np
import pytest
from plane_survey import SIZE, TILTED, PlaneBed, ring

from fields.sweep.block import Block
from fields.sweep.maps import HeightMap, trusted, upsample_map
from fields.sweep.passes import PASSES as USUAL
from fields.sweep.passes import Pass, passes_from
from fields.sweep.sweep import EarlierMaps, sweep
from fields.sweep.view_pass import SweepSettings

BED = PlaneBed(TILTED, -2.0, slope=0.1)
PASSES = (
    Pass(0.5, 2, None, 0.5, 6, False),
    Pass(1.0, 2, 7, 0.4, 6, True),
    Pass(1.0, 1, 3, 0.25, 8, True),
)
# Median errors of trusted heights [m]; a pixel is 1.5 cm. Measured 0.7 mm at full size and 2 mm at half of it.
FINE_M, COARSE_M = 1.5e-3, 4e-3
AGAIN = (0, 1, 2)


@pytest.fixture(scope="module")
def halved(device) -> tuple[tuple[float, float], list[HeightMap]]:
    """The bound, and the maps of a sweep with images of half the size."""
    cameras = ring(6)
    truth = BED.true_height(cameras[0])
    bound = (float(truth.min()) - 0.3, float(truth.max()) + 0.4)
    block = BED.block(device, [camera.scaled(0.5) for camera in cameras], None)
    return bound, sweep(block, list(range(7)), SweepSettings(bound, PASSES), lambda share: None)


@pytest.fixture(scope="module")
def gone_on(device, halved) -> tuple[Block, list[HeightMap], list[float]]:
    """The block at full size, its maps after three of seven views went on, and what the progress was told."""
    bound, before = halved
    block, shares = BED.block(device, ring(6), None), []
    maps = sweep(
        block,
        list(range(7)),
        SweepSettings(bound, PASSES),
        shares.append,
        earlier=EarlierMaps({m.view: m for m in before}, list(AGAIN)),
    )
    return block, maps, shares


def median_error(block: Block, m: HeightMap) -> float:
    return float(np.median(np.abs(m.height - BED.true_height(block.cameras[m.view]))[trusted(m)]))


def test_views_that_go_on_are_as_good_as_swept_at_once(gone_on):
    block, maps, _ = gone_on
    for m in maps:
        if m.view in AGAIN:
            assert m.height.shape == SIZE[::-1]
            assert trusted(m).mean() > 0.5
            assert median_error(block, m) < FINE_M


def test_the_others_keep_their_heights_enlarged(gone_on, halved):
    block, maps, _ = gone_on
    for m, earlier in zip(maps, halved[1], strict=True):
        if m.view not in AGAIN:
            enlarged = upsample_map(earlier, SIZE)
            np.testing.assert_array_equal(m.height, enlarged.height)
            np.testing.assert_array_equal(m.spread, enlarged.spread)
            assert (m.agreeing >= enlarged.agreeing).all()
            assert median_error(block, m) < COARSE_M


def test_progress_counts_only_the_passes_that_are_left(gone_on):
    _, _, shares = gone_on
    # Two passes of three views, each followed by a fusion.
    assert len(shares) == 2 * (len(AGAIN) + 1)
    assert shares[-1] == pytest.approx(1.0)
    assert shares == sorted(shares)


def test_a_map_enlarged_by_two_has_the_heights_between_its_pixels():
    rows, columns = np.mgrid[0:6, 0:8].astype(np.float32)
    plane = (2.0 * columns + rows).astype(np.float32)
    agreeing = np.arange(48, dtype=np.uint8).reshape(6, 8)
    large = upsample_map(HeightMap(3, plane, plane, agreeing, plane), (16, 12))
    assert large.view == 3
    # Centres of the pixels of half the size lie a quarter of the large pixel before and behind.
    np.testing.assert_allclose(large.height[4, 2:-2], 2.0 * (np.arange(2, 14) / 2 - 0.25) + 1.75, atol=1e-5)
    np.testing.assert_array_equal(large.agreeing[::2, ::2], agreeing)
    assert upsample_map(large, (16, 12)) is large


def test_small_images_are_searched_at_more_of_their_size():
    assert passes_from(0.25) == passes_from(0.125) == USUAL
    for share in (0.5, 1.0):
        first, *rest = passes_from(share)
        assert first.hypotheses is None
        assert first.scale == share
        assert all(p.hypotheses is not None for p in rest)
        assert rest[-1] == USUAL[-1]
