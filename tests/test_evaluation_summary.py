"""Statistics of distances: of all, by depth and shore, and in cells."""

import math

import numpy as np
import pytest

from evaluation import by_band, by_depth, distance_statistics, scores, spatial_blocks
from evaluation.bootstrap import cell_counts, cell_means, cell_numbers

EXACT = {"rel": 1e-12, "abs": 1e-15}


def test_ten_distances_by_hand():
    """Of |d| = 1 to 10 the 0.9 quantile is 9.1: the inner ones are 1 to 9, the odd ones negative."""
    d = np.array([-1.0, 2, -3, 4, -5, 6, -7, 8, -9, 10])
    numbers = distance_statistics(d)
    assert numbers.n_points == 10
    assert numbers.mean_m == pytest.approx(0.5, **EXACT)
    assert numbers.median_m == pytest.approx(0.5, **EXACT)
    assert numbers.rms_m == pytest.approx(math.sqrt(38.5), **EXACT)
    assert numbers.std_m == pytest.approx(math.sqrt(38.5 - 0.25), **EXACT)
    assert numbers.mean_inner90_m == pytest.approx(-5 / 9, **EXACT)
    assert numbers.std_inner90_m == pytest.approx(math.sqrt(285 / 9 - 25 / 81), **EXACT)
    assert numbers.p95_abs_m == pytest.approx(9.55, **EXACT)
    assert (numbers.min_m, numbers.max_m) == (-9.0, 10.0)
    # Deviations from 0.5 are 1.5, 1.5, 3.5, 3.5, ..., 9.5, 9.5: their median is 5.5.
    assert numbers.nmad_m == pytest.approx(1.4826 * 5.5, **EXACT)


def test_the_inner_part_includes_the_quantile_itself():
    d = np.array([0.1] * 9 + [5.0])
    assert distance_statistics(np.full(7, -0.3)).mean_inner90_m == pytest.approx(-0.3, **EXACT)
    assert distance_statistics(d).std_inner90_m == pytest.approx(0.0, abs=1e-15)


def test_normal_errors_give_the_moments_of_a_truncated_normal(rng):
    """Inside |d| < 1.645 sigma the variance is 1 - 2 * 1.645 * phi(1.645) / 0.9 = 0.6230."""
    d = rng.normal(0.0, 0.012, 400_000)
    numbers = distance_statistics(d)
    phi = math.exp(-0.5 * 1.6448536**2) / math.sqrt(2 * math.pi)
    inner = 0.012 * math.sqrt(1 - 2 * 1.6448536 * phi / 0.9)
    # Relative error of a standard deviation: 1 / sqrt(2 n); six of them.
    assert numbers.std_inner90_m == pytest.approx(inner, rel=6 / math.sqrt(2 * 360_000))
    assert numbers.nmad_m == pytest.approx(0.012, rel=0.02)


def test_nan_is_counted_and_left_out_and_no_distance_at_all_gives_nan_without_a_warning():
    numbers = distance_statistics(np.array([np.nan, 0.5, np.nan, 0.5]))
    assert (numbers.n_points, numbers.n_nan, numbers.mean_m) == (2, 2, 0.5)
    numbers = distance_statistics(np.array([]))
    assert numbers.n_points == 0
    assert math.isnan(numbers.std_inner90_m)


def test_scores_at_one_tolerance():
    distances, reached = np.array([0.1, -0.2, np.nan, 0.3, -0.1]), np.array([True, False, True, True])
    found = scores(distances, tolerance_m=0.2, is_reached=reached, is_reached_visible=np.array([True, True]))
    assert (found.completeness, found.completeness_visible) == (0.75, 1.0)
    # |d| = 0.2 is not closer than 0.2.
    assert found.accuracy_share == 0.5
    assert found.f_score == pytest.approx(0.6, **EXACT)
    assert scores(distances, tolerance_m=0.2, is_reached=reached).completeness_visible is None


def test_wet_and_dry_are_split_five_centimetres_off_the_shoreline():
    depth = np.array([-1.0, -0.04, 0.04, 0.3, 0.7, 1.0, 45.0, np.nan])
    d = np.array([1.0, 2, 3, 4, 5, 6, 7, 8])
    parts = by_depth(d, depth)
    assert (parts.dry.n_points, parts.dry.mean_m) == (1, 1.0)
    assert (parts.wet.n_points, parts.wet.mean_m) == (4, 5.5)
    bands = [(b.low, b.high, b.distances.n_points) for b in parts.bands]
    assert bands == [(0.0, 0.5, 2), (0.5, 1.0, 1), (1.0, 2.0, 1), (30.0, math.inf, 1)]
    assert by_depth(d[:2], depth[:2]).wet is None


def test_the_lower_limit_of_a_band_belongs_to_it_and_empty_bands_are_left_out():
    d = np.array([1.0, 2.0, 3.0, 4.0])
    bands = by_band(d, np.array([0.0, 5.0, 7.0, np.nan]), (0.0, 5.0, 6.0, 7.0, math.inf))
    means = [(b.low, b.high, b.distances.mean_m) for b in bands]
    assert means == [(0.0, 5.0, 1.0), (5.0, 6.0, 2.0), (7.0, math.inf, 3.0)]


def test_a_band_has_the_interval_of_its_own_points(rng):
    plan = rng.uniform(0.0, 50.0, (20_000, 2))
    d = np.where(plan[:, 0] < 25.0, 0.01, 0.03) + rng.normal(0.0, 0.001, 20_000)
    shallow, deep = by_band(d, plan[:, 0], (0.0, 25.0, 50.0), spatial_blocks(plan, d))
    assert shallow.distances.mean_ci95_m[0] < 0.01 < shallow.distances.mean_ci95_m[1] < 0.011
    assert deep.distances.mean_ci95_m[0] < 0.03 < deep.distances.mean_ci95_m[1] < 0.031


SHAPE = (2, 3)
# Column and row: two in the first cell, one in the last, one on the outer edge, one before it, one without a place.
AT = np.array([[0.0, 0.0], [0.9, 0.9], [2.5, 1.5], [3.0, 0.0], [-0.1, 1.0], [np.nan, 0.0]])


def test_cells_are_numbered_row_by_row_and_what_lies_beyond_or_is_nan_counts_nowhere():
    number, values = cell_numbers(AT, SHAPE), np.array([1.0, np.nan, np.nan, 7.0, 7.0, 7.0])
    assert number.tolist() == [0, 0, 5, -1, -1, -1]
    assert cell_counts(number, SHAPE).tolist() == [[2, 0, 0], [0, 0, 1]]
    np.testing.assert_array_equal(cell_means(number, values, SHAPE), [[1.0, *[np.nan] * 2], [np.nan] * 3])
