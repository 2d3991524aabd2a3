"""The standard deviation of the heights of the sweep alone."""

import numpy as np
import pytest

from fields.sweep.maps import height_std, small_sample_factor

SHAPE = (48, 56)
PLANE = (0.02 * np.arange(SHAPE[0])[:, None] - 0.05 * np.arange(SHAPE[1])).astype(np.float32)
INNER = np.s_[16:-16, 16:-16]
TOLERANCE = 0.1


def test_on_a_plane_it_is_that_of_a_mean_of_heights_that_disagree():
    heights = np.array([-2.0, -2.02, -1.97])
    std = height_std(PLANE, np.full(SHAPE, 2, np.uint8), np.full(SHAPE, np.std(heights)), TOLERANCE)
    expected = np.sqrt(small_sample_factor(np.array([3])) * np.var(heights, ddof=1) / 3.0)
    np.testing.assert_allclose(std[INNER], expected[0], rtol=1e-3)


def test_heights_that_agree_by_chance_are_no_surer_than_those_around_them():
    spread = np.full(SHAPE, 0.02)
    spread[24, 28] = 0.0
    std = height_std(PLANE, np.full(SHAPE, 1, np.uint8), spread, TOLERANCE)
    assert std[24, 28] > 0.9 * std[24, 32]


def test_views_that_confirm_nothing_disagree_about_nothing():
    agreeing, spread = np.full(SHAPE, 3, np.uint8), np.full(SHAPE, 0.02)
    agreeing[:, ::2], spread[:, ::2] = 0, 0.0
    whole = height_std(PLANE, np.full(SHAPE, 3, np.uint8), np.full(SHAPE, 0.02), TOLERANCE)
    np.testing.assert_allclose(
        height_std(PLANE, agreeing, spread, TOLERANCE)[INNER][:, 1::2], whole[INNER][:, 1::2], rtol=0.01
    )


def test_a_rough_map_is_less_sure_than_a_plane():
    rough = PLANE + 0.02 * np.random.default_rng(1).standard_normal(SHAPE).astype(np.float32)
    agreeing, nothing = np.full(SHAPE, 9, np.uint8), np.zeros(SHAPE)
    assert height_std(PLANE, agreeing, nothing, TOLERANCE)[INNER].max() < 1e-4
    assert np.median(height_std(rough, agreeing, nothing, TOLERANCE)[INNER]) > 0.005


def test_fewer_photographs_leave_a_larger_variance():
    factor = small_sample_factor(np.array([2, 3, 8, 40]))
    assert (np.diff(factor) < 0.0).all()
    assert 1.0 < factor[-1] < 1.1


def test_noise_that_disagrees_and_bends_counts_once():
    rough = PLANE + 0.02 * np.random.default_rng(1).standard_normal(SHAPE).astype(np.float32)
    agreeing = np.full(SHAPE, 9, np.uint8)
    both, bends, spread = (
        np.median(height_std(height, agreeing, np.full(SHAPE, part), TOLERANCE)[INNER])
        for height, part in ((rough, 0.02), (rough, 0.0), (PLANE, 0.02))
    )
    assert both < 1.05 * max(bends, spread)


def test_where_fewer_views_agree_than_beside_it_the_others_see_another_height():
    agreeing, spread = np.full(SHAPE, 9, np.uint8), np.full(SHAPE, 0.01)
    agreeing[22:26, 26:30] = 1
    near, far = (height_std(PLANE, agreeing, spread, tolerance)[24, 28] for tolerance in (TOLERANCE, 2.0 * TOLERANCE))
    alone = height_std(PLANE, np.full(SHAPE, 1, np.uint8), spread, TOLERANCE)[24, 28]
    assert near > 2.0 * alone
    assert far == pytest.approx(2.0 * near, rel=0.1)


def test_photographs_that_are_masked_at_a_place_see_no_other_height_there():
    agreeing, spread = np.full(SHAPE, 9, np.uint8), np.full(SHAPE, 0.01)
    agreeing[22:26, 26:30] = 1
    of_all = height_std(PLANE, agreeing, spread, TOLERANCE)
    # All others have a height there, or none of them has one.
    np.testing.assert_array_equal(height_std(PLANE, agreeing, spread, TOLERANCE, np.full(SHAPE, 9.0)), of_all)
    std = height_std(PLANE, agreeing, spread, TOLERANCE, agreeing.astype(np.float32))
    alone = height_std(PLANE, np.full(SHAPE, 1, np.uint8), spread, TOLERANCE)
    assert std[24, 28] < 1.2 * alone[24, 28]
