"""Wide windows for what two photographs show under water: their std, their means, and where they are left out."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from rippled_pair import SIZE, rippled_pair

from fields.sweep.bed import is_supported
from fields.sweep.maps import HeightMap, OrderedMaps, height_std, trusted
from fields.sweep.sweep import sweep
from fields.sweep.view_pass import SweepSettings
from fields.sweep.wide_windows import averaged, wet_pairs, window_std, with_wide_windows

SHAPE, NOISE_M = (170, 204), 0.5
# As many pixels as a wide window has on a side.
WINDOW_PX = 17


def wide_map(seed: int = 0) -> HeightMap:
    """A sloping bed with an error for each window of its own."""
    rng = np.random.default_rng(seed)
    row, column = np.indices(SHAPE)
    noise = NOISE_M * rng.standard_normal((SHAPE[0] // WINDOW_PX, SHAPE[1] // WINDOW_PX))
    height = -3.0 + 0.01 * column - 0.02 * row + np.kron(noise, np.ones((WINDOW_PX, WINDOW_PX)))
    one = np.ones(SHAPE, np.float16)
    return HeightMap(0, height.astype(np.float32), np.float16(0.95) * one, one.astype(np.uint8), 0 * one)


def test_the_std_of_windows_is_that_of_their_errors_and_not_of_a_slope():
    found = [np.mean(window_std(wide_map(seed)) ** 2) for seed in range(10)]
    # Ten maps of 120 windows, of which second differences share values.
    assert np.sqrt(np.mean(found)) == pytest.approx(NOISE_M, rel=0.1)
    flat = wide_map()
    flat.height[:] = -3.0 + 0.01 * np.indices(SHAPE)[1]
    assert window_std(flat).max() < 1e-3


def test_averaged_heights_err_by_what_their_spread_says():
    ratios = []
    for seed in range(10):
        m = averaged(wide_map(seed))
        row, column = np.indices(SHAPE)
        # Without the rim, where a mean of a slope leans inwards.
        inner = np.s_[30:-30, 30:-30]
        error = (m.height - (-3.0 + 0.01 * column - 0.02 * row))[inner]
        std = height_std(m.height, m.agreeing, m.spread, 1.0)[inner]
        ratios.append(np.mean(error**2) / np.mean(std**2))
    assert 0.5 < np.sqrt(np.mean(ratios)) < 1.0


def test_a_false_match_does_not_pull_the_mean():
    m, wrong = wide_map(), wide_map()
    wrong.height[80:90, 100:110] += 8.0
    assert np.abs(averaged(wrong).height - averaged(m).height).max() < 0.3


def block(neighbours: int, water: object):
    return SimpleNamespace(water=water, neighbours=lambda view, count: list(range(neighbours)))


@pytest.mark.parametrize(("neighbours", "water"), [(2, object()), (1, None), (12, None)])
def test_maps_stay_as_they_are_where_a_third_photograph_looks_or_all_is_dry(neighbours, water):
    maps = OrderedMaps({0: wide_map()}, [0])
    assert with_wide_windows(block(neighbours, water), maps, (-5.0, 5.0), None) is maps


def test_two_photographs_of_water_are_a_pair():
    assert wet_pairs(block(1, object()), [0, 1]) == [0, 1]


@pytest.mark.slow
def test_ripples_that_moved_leave_the_bed_in_its_place():
    inside, errors = [], []
    for seed in range(4):
        pair, bound = rippled_pair(seed), (-8.0, 4.0)
        narrow = sweep(pair.block, [0, 1], SweepSettings(bound), lambda _share: None)
        wide = with_wide_windows(pair.block, narrow, bound, None)
        for before, after, truth in zip(narrow, wide, pair.truth, strict=True):
            tolerance = pair.block.agreement_tolerance(after.view, [1 - after.view], -pair.depth)
            ours = np.s_[: SIZE[1], : SIZE[0]]
            of_ripples, kept = (is_supported(m.height, trusted(m), tolerance)[ours] for m in (before, after))
            # Without wide windows hardly a pixel is a point.
            assert of_ripples.mean() < 0.02
            assert kept.mean() > 0.15
            error = (after.height[ours] - truth)[kept]
            std = height_std(after.height, after.agreeing, after.spread, tolerance)[ours][kept]
            errors.append(error)
            inside.append(np.abs(error) < 1.96 * std)
    # Of beds 2 to 4 m deep, at 6 cm a pixel.
    assert np.sqrt(np.mean(np.concatenate(errors) ** 2)) < 0.1
    assert np.concatenate(inside).mean() > 0.8
