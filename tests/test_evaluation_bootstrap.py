"""The confidence of a mean: independent errors, correlated ones, and too few of them."""

import math

import numpy as np
import pytest

from evaluation import mean_interval, spatial_blocks

# Half the width of an interval of 95 % in standard errors.
Z95 = 1.959964


def _half_width(plan, errors) -> float:
    low, high = mean_interval(errors, spatial_blocks(plan, errors))
    return 0.5 * (high - low)


def _field(rng, side, window):
    """Points of a grid of unit spacing, and white noise of unit variance averaged over windows around them."""
    white = rng.normal(size=(side + window - 1, side + window - 1))
    sums = np.lib.stride_tricks.sliding_window_view(white, (window, window)).sum(axis=(2, 3))
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    return np.stack([x.ravel(), y.ravel()], axis=1).astype(float), sums.ravel() / window


def test_independent_errors_give_sigma_over_root_n(rng):
    plan = rng.uniform(0.0, 30.0, (50_000, 2))
    errors = rng.normal(0.004, 0.02, 50_000)
    assert spatial_blocks(plan, errors).correlation_m == 0.0
    # The standard error of a standard error from the 780 blocks there are is 1 / sqrt(2 * 780) = 2.5 %; quantiles of
    # 1000 draws add about 4 %, the widening for what crosses the edges of blocks up to 3 %. Three of all together.
    assert _half_width(plan, errors) == pytest.approx(Z95 * 0.02 / math.sqrt(50_000), rel=0.15)


def test_correlated_errors_widen_the_interval_by_the_window_that_they_share(rng):
    """Sums over windows of k by k have the correlation (1 - |dx| / k) (1 - |dy| / k), whose sum is k squared."""
    window, side = 12, 600
    plan, errors = _field(rng, side, window)
    blocks = spatial_blocks(plan, errors)
    # Along an axis the correlation falls to 1/e at 0.63 windows, along a diagonal at 0.56 of them.
    assert blocks.correlation_m == pytest.approx(0.6 * window, rel=0.15)
    expected = Z95 * window / side
    # The 69 blocks tell a standard error to 8.5 %, those of half their edge to 4 %, twice weighted; twice both.
    assert _half_width(plan, errors) == pytest.approx(expected, rel=0.2)
    assert _half_width(plan, errors) > 8.0 * Z95 * errors.std() / len(errors) ** 0.5


def test_an_exponential_correlation_is_not_cut_at_the_edges_of_blocks():
    """Fields with the covariance exp(-r / 3) over 240 by 240 points: some 40 blocks of ten correlation lengths."""
    side, length, half_widths = 240, 3.0, []
    frequency = 2.0 * np.pi * np.hypot(*np.meshgrid(*2 * [np.fft.fftfreq(2 * side)]))
    amplitude = (1.0 + (frequency * length) ** 2) ** -0.75
    plan = np.stack(np.meshgrid(np.arange(side), np.arange(side)), axis=-1).reshape(-1, 2).astype(float)
    for seed in range(10):
        white = np.random.default_rng(seed).normal(size=(2 * side, 2 * side))
        field = np.fft.ifft2(np.fft.fft2(white) * amplitude).real[:side, :side].ravel()
        half_widths.append(_half_width(plan, field))
    # The variance of the mean: the covariance of all pairs, of which there are fewer at longer lags.
    pairs = np.clip(1.0 - np.abs(np.fft.fftfreq(2 * side, 0.5 / side)) / side, 0.0, None)
    variance = (np.fft.ifft2(amplitude**2).real * np.multiply.outer(pairs, pairs)).sum() / side**2
    # 40 blocks and those of half their edge tell a standard error to 12 %, ten of them to 4 %; three of those.
    assert np.mean(half_widths) == pytest.approx(Z95 * math.sqrt(variance), rel=0.12)


def test_noise_of_single_points_does_not_hide_what_neighbours_share(rng):
    plan, shared = _field(rng, 400, 10)
    errors = shared + rng.normal(0.0, 3.0, len(shared))
    assert spatial_blocks(plan, errors).correlation_m == pytest.approx(6.0, rel=0.5)


def test_nineteen_of_twenty_intervals_hold_the_truth():
    held = 0
    for seed in range(100):
        rng = np.random.default_rng(seed)
        plan = rng.uniform(0.0, 10.0, (2000, 2))
        errors = rng.normal(0.0, 1.0, 2000)
        low, high = mean_interval(errors, spatial_blocks(plan, errors))
        held += low < 0.0 < high
    # Binomial, 100 draws of 0.95: a standard deviation of 2.2; three of them.
    assert 88 <= held <= 100


def test_a_survey_as_small_as_its_correlation_says_that_its_interval_is_short(rng):
    plan, errors = _field(rng, 60, 30)
    assert spatial_blocks(plan, errors).is_narrow


def test_too_few_blocks_give_no_interval():
    plan = np.stack([np.arange(9.0), np.zeros(9)], axis=1)
    assert np.isnan(mean_interval(np.ones(9), spatial_blocks(plan, np.ones(9)))).all()
    assert np.isnan(mean_interval(np.full(3, np.nan), spatial_blocks(np.zeros((3, 2)), np.full(3, np.nan)))).all()


def test_points_that_are_nan_take_part_in_nothing(rng):
    plan = rng.uniform(0.0, 30.0, (5000, 2))
    errors = rng.normal(size=5000)
    gaps = np.append(errors, [np.nan, np.nan])
    more = np.vstack([plan, [[1.0, 1.0], [np.nan, np.nan]]])
    assert mean_interval(gaps, spatial_blocks(more, gaps)) == mean_interval(errors, spatial_blocks(plan, errors))


def test_the_same_points_give_the_same_interval_and_one_spot_is_no_survey():
    assert np.isnan(mean_interval(np.arange(50.0), spatial_blocks(np.full((50, 2), 7.0), np.arange(50.0)))).all()
