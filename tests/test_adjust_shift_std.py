"""What an error of all places in plan does to heights at their places."""

from __future__ import annotations

import math

import numpy as np
import pytest

from survey.adjust.std_common import shift_std


def grid(height, side: float = 30.0, step: float = 0.1) -> np.ndarray:
    x, y = np.meshgrid(np.arange(0.0, side, step), np.arange(0.0, side, step))
    return np.column_stack([x.ravel(), y.ravel(), height(x, y).ravel()])


@pytest.mark.parametrize("std", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("slope", [(0.1, 0.0), (0.0, -0.3), (0.2, 0.1)])
def test_on_a_slope_it_is_slope_times_shift(slope, std):
    found = shift_std(grid(lambda x, y: slope[0] * x + slope[1] * y), std)
    inner = np.median(found)
    assert inner == pytest.approx(math.hypot(*slope) * std, rel=0.02)


def test_over_a_flat_bed_it_is_nothing_and_a_single_point_has_that_of_the_cloud():
    assert shift_std(grid(lambda x, y: 0.0 * x), 2.0).max() == 0.0
    sloped = grid(lambda x, y: 0.1 * x)
    found = shift_std(np.vstack([sloped, [500.0, 500.0, 3.0]]), 2.0)
    assert found[-1] == pytest.approx(0.2, rel=0.1)


def test_over_ripples_it_is_what_shifted_ripples_differ_by():
    ripples = grid(lambda x, y: 0.1 * np.sin(2.0 * math.pi * x / 3.0))
    found = np.sqrt(np.mean(shift_std(ripples, 2.0) ** 2))
    rng = np.random.default_rng(1)
    x, shift = rng.uniform(0.0, 30.0, 20000), 2.0 * rng.standard_normal(20000)
    wanted = np.std(0.1 * (np.sin(2.0 * math.pi * (x + shift) / 3.0) - np.sin(2.0 * math.pi * x / 3.0)))
    assert found == pytest.approx(wanted, rel=0.35)
