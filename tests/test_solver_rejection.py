"""Pixels that keep the height of the sweep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from solved_tiles import level, residuals, white

from fields.solver.gauss_newton import Start
from fields.solver.noise import NoiseShares
from fields.solver.solver import rejects_update, sweep_slope_noise_ratio
from fields.solver.tile import brightness_of, log_likelihood_ratio
from fields.solver.uncertainty import expected_variances

TOLERANCE = 0.05
NOISE = NoiseShares(response=1.0, height_variance_ratio=1.0, smoothing_variance_ratio=1.0, excess_relief=0.0)


def kept(slope: float = 0.0, gain: float = 0.0, by_noise: float = 1e-8, noise: NoiseShares = NOISE) -> np.ndarray:
    """Of a tile whose pixels in the middle are so steep in the sweep, or were solved with such a gain."""
    tile, solved = level(1e4, 0.01)
    middle = np.zeros((40, 40), dtype=np.float32)
    middle[18:22, 18:22] = 1.0
    of_middle = middle.ravel()
    start = Start(solved.height, slope * of_middle)
    solved = replace(solved, start=start, improvement=gain * of_middle)
    found = rejects_update(tile, solved, np.full(len(tile), by_noise), noise, 1.0, TOLERANCE)
    assert not found[middle.ravel() == 0.0].any() or gain < 0.0
    return found.reshape(40, 40)[19:21, 19:21]


def test_a_pixel_on_a_wall_keeps_the_height_of_the_sweep_and_one_on_a_slope_is_solved():
    assert kept(slope=1.1 * TOLERANCE).all()
    assert not kept(slope=0.9 * TOLERANCE).any()


def test_what_only_looks_steep_in_noise_is_solved():
    assert not kept(slope=2.0 * TOLERANCE, by_noise=(TOLERANCE / 2.9) ** 2).any()
    assert kept(slope=2.0 * TOLERANCE, by_noise=(TOLERANCE / 3.1) ** 2).all()


@pytest.mark.parametrize(("share", "limit"), [(0.5, 13.95), (1.0, 13.95), (2.5, 34.9)])
def test_a_solved_height_that_the_photographs_refute_is_not_taken_and_shared_noise_refutes_less(share, limit):
    noise = replace(NOISE, height_variance_ratio=share)
    assert kept(gain=-1.01 * limit / 9.0, noise=noise).all()
    assert not kept(gain=-0.99 * limit / 9.0, noise=noise).any()
    assert not kept(gain=limit, noise=noise).any()


def test_a_pixel_of_which_no_second_photograph_has_a_say_keeps_the_height_of_the_sweep():
    tile, solved = level(1e4, 0.01)
    weight = np.ones((3, len(tile)), dtype=np.float32)
    weight[1:, :5] = 0.0
    weight[2:, 5:9] = 0.0
    solved = replace(
        solved, brightness=replace(solved.brightness, weight=weight), improvement=np.zeros(len(tile), np.float32)
    )
    solved = replace(solved, start=Start(solved.height, np.zeros(len(tile), np.float32)))
    found = rejects_update(tile, solved, np.full(len(tile), 1e-8), NOISE, 1.0, TOLERANCE)
    assert found[:5].all()
    assert not found[5:].any()


def test_slopes_by_noise_are_those_of_heights_that_are_noise_alone(rng):
    tile, solved = level(1e4, 0.01, size=80)
    std = float(np.sqrt(expected_variances(tile, solved, 1.0).noise.mean()))
    noisy = (3.0 * std * rng.standard_normal(len(tile))).astype(np.float32)
    noisy[tile.number[30:33, 30:33].ravel()] = 5.0
    moved = replace(solved, start=Start(solved.height - noisy, noisy))
    # Of the plane through nine independent heights each component is known to the root of a sixth of their variance.
    assert sweep_slope_noise_ratio([(tile, moved)], 0.01, NOISE) == pytest.approx(3.0 / np.sqrt(6.0), rel=0.06)


def test_gain_is_large_where_photographs_came_to_agree_and_leaves_out_what_only_one_time_shows():
    _, solved = residuals(white(5))
    now, apart = solved.brightness, white(5, seed=2).reshape(5, -1)
    assert log_likelihood_ratio(now, now) == pytest.approx(0.0)
    worse = brightness_of((now.albedo + 3.0 * apart).astype(np.float32))
    assert np.median(log_likelihood_ratio(worse, now)) > 5.0
    unseen = replace(worse, weight=0.0 * worse.weight)
    assert (log_likelihood_ratio(unseen, now) == 0.0).all()
