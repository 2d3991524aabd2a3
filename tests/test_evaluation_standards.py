"""Vertical accuracy by two standards, check points and outliers: by hand and by closed forms."""

import math

import numpy as np
import pytest

from evaluation import asprs_vertical, height_at, iho_s44, is_outlier


@pytest.mark.parametrize(
    ("depth_m", "limits"), [(1.0, [0.150, 0.250, 0.500, 1.000]), (10.0, [0.168, 0.261, 0.517, 1.026])]
)
def test_tvu_limits_are_those_of_iho_s44(depth_m, limits):
    orders = iho_s44(np.zeros(100), np.full(100, depth_m)).orders
    assert [o.tvu_at_median_depth_m for o in orders] == pytest.approx(limits, abs=5e-4)
    assert all(o.meets_tvu for o in orders)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize(("num_bad", "meets"), [(5, True), (6, False)])
def test_an_order_is_met_where_95_per_cent_of_the_errors_are_within_its_tvu(num_bad, meets, sign):
    errors = np.where(np.arange(100) < num_bad, sign * 0.2, 0.0)
    exclusive, special, *_ = iho_s44(errors, np.ones(100)).orders
    assert exclusive.share_within == pytest.approx(1.0 - num_bad / 100)
    assert exclusive.meets_tvu is meets
    assert special.meets_tvu is True  # 0.2 m is within 0.25 m


def test_the_share_within_is_told_by_depth_and_dry_points_do_not_count():
    depth = np.array([-1.0, 0.2, 0.4, 1.5, 1.6, 50.0, 1.0, np.nan])
    errors = np.array([9.0, 0.0, 0.2, 0.0, -0.1, 0.3, np.nan, 0.0])
    numbers = iho_s44(errors, depth)
    assert numbers.n_points == 5
    bands = [(b.low_m, b.high_m, b.n_points, b.share_within) for b in numbers.orders[0].bands]
    # At 50 m the order "Exclusive" allows sqrt(0.15^2 + 0.375^2) = 0.40 m.
    assert bands == [(0.0, 0.5, 2, 0.5), (1.0, 2.0, 2, 1.0), (30.0, math.inf, 1, 1.0)]


def test_an_order_that_one_depth_does_not_meet_is_not_met_at_all_depths():
    """Of 40,000 points 250 are off by 0.2 m: 10 % of those at 1.5 m, and all of the few at 0.2 m."""
    depth = np.repeat([1.5, 3.5, 0.2], [2000, 37_950, 50])
    errors = np.zeros(40_000)
    errors[:200] = errors[-50:] = 0.2
    iho = iho_s44(errors, depth)
    exclusive, special, *_ = iho.orders
    assert exclusive.meets_tvu
    assert [(band.low_m, band.high_m) for band in exclusive.failing] == [(1.0, 2.0)]  # 50 points are not judged
    assert not exclusive.meets_tvu_at_all_depths
    assert iho.strictest == special
    assert iho_s44(np.full(5, 9.0), np.ones(5)).strictest is None
    # Nothing is judged without a point under water.
    assert iho_s44(np.zeros(3), np.array([-1.0, np.nan, 0.0])) is None


def test_rmse_by_hand_holds_the_error_of_the_check_points():
    numbers = asprs_vertical(np.array([0.03, -0.01, np.nan, 0.01, -0.03]), np.full(5, 0.02))
    assert (numbers.n_checkpoints, numbers.n_not_covered, numbers.is_enough) == (4, 1, False)
    assert numbers.rmse_fit_m == pytest.approx(math.sqrt(5e-4))
    assert numbers.rmse_v_m == pytest.approx(0.03)  # 5e-4 + 4e-4
    assert numbers.mean_m == pytest.approx(0.0, abs=1e-15)
    assert numbers.std_m == pytest.approx(math.sqrt(20e-4 / 3))
    assert asprs_vertical(np.zeros(30), np.zeros(30)).is_enough
    assert math.isnan(asprs_vertical(np.full(2, np.nan), np.zeros(2)).rmse_v_m)


def test_a_plane_is_met_exactly_and_noise_on_it_by_its_twelfth(rng):
    x, y = np.meshgrid(np.arange(0.0, 10.0, 0.1), np.arange(0.0, 10.0, 0.1))
    cloud = np.column_stack([x.ravel(), y.ravel(), 0.3 * x.ravel() - 0.2 * y.ravel() + 7.0])
    places = rng.uniform(1.0, 9.0, (400, 2))
    truth = 0.3 * places[:, 0] - 0.2 * places[:, 1] + 7.0
    np.testing.assert_allclose(height_at(cloud, places), truth, atol=1e-12)
    noisy = cloud + np.column_stack([np.zeros((len(cloud), 2)), rng.normal(0.0, 0.01, len(cloud))])
    # A plane through twelve points is sure to sigma / sqrt(12) in their middle, a little less beside it; 400 such
    # errors tell their spread to 3.5 %.
    spread = (height_at(noisy, places) - truth).std()
    assert 0.9 * 0.01 / math.sqrt(12) < spread < 1.25 * 0.01 / math.sqrt(12)


def test_places_off_the_cloud_on_its_rim_or_on_a_line_have_no_height():
    x, y = np.meshgrid(np.arange(0.0, 5.0, 0.1), np.arange(0.0, 5.0, 0.1))
    cloud = np.column_stack([x.ravel(), y.ravel(), x.ravel()])
    places = np.array([[9.0, 9.0], [-0.3, 2.5], [2.5, 2.5]])
    assert np.isfinite(height_at(cloud, places)).tolist() == [False, False, True]
    line = np.column_stack([np.arange(0.0, 5.0, 0.1), np.zeros(50), np.zeros(50)])
    assert np.isnan(height_at(line, np.array([[2.5, 0.0]]))).all()
    assert np.isnan(height_at(np.empty((0, 3)), places)).all()
    assert np.isnan(height_at(np.full((3, 3), np.nan), places)).all()


def test_points_that_stand_apart_are_outliers_and_no_others(rng):
    x, y = np.meshgrid(np.arange(40.0), np.arange(40.0))
    cloud = np.column_stack([x.ravel(), y.ravel(), rng.normal(0.0, 0.05, x.size)])
    cloud[[100, 700], 2] += 5.0
    assert np.flatnonzero(is_outlier(cloud, neighbours=6, num_std=4.0)).tolist() == [100, 700]


def test_the_limit_is_the_mean_and_its_multiple_of_standard_deviations():
    """On a line at 0, 1, 2, 3, 7 the nearest are 1, 1, 1, 1, 4 away: mean 1.6, standard deviation 1.2."""
    cloud = np.column_stack([[0.0, 1.0, 2.0, 3.0, 7.0], np.zeros(5), np.zeros(5)])
    assert is_outlier(cloud, neighbours=1, num_std=1.99).tolist() == [False] * 4 + [True]
    assert not is_outlier(cloud, neighbours=1, num_std=2.01).any()
    assert not is_outlier(cloud[:1], neighbours=6, num_std=2.0).any()
