"""Levels from a gauge series."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from refract import crossing_point, project, trace
from refract.surfaces import FlatWater, TidalWater


def test_readings_are_met_and_the_level_is_linear_between():
    water = TidalWater([0.0, 600.0, 1500.0], [1.0, 1.4, 1.1], point=(5.0, 6.0), n_water=1.34, slope_x=0.01)
    for time, level in ((0.0, 1.0), (600.0, 1.4), (1500.0, 1.1), (150.0, 1.1), (1050.0, 1.25)):
        flat = water.at(time)
        assert isinstance(flat, FlatWater)
        assert abs(flat.height(5.0, 6.0) - level) < 1e-15
    assert (flat.n_water, flat.slope_x, flat.slope_y) == (1.34, 0.01, 0.0)


def test_dates_give_the_same_levels_as_seconds():
    start = np.datetime64("2026-06-01T10:00:00")
    seconds = np.array([0, 600, 1200])
    dated = TidalWater(start + seconds.astype("timedelta64[s]"), [1.0, 1.4, 1.3])
    plain = TidalWater(seconds, [1.0, 1.4, 1.3])
    found = dated.at(start + np.timedelta64(700_250, "ms")).point[2]
    assert abs(found - plain.at(700.25).point[2]) < 1e-15


@pytest.mark.parametrize(("minutes", "stated_mm"), [(10, 0.9), (60, 32.0)])
def test_linear_levels_miss_a_tide_by_what_is_stated(minutes, stated_mm):
    period, step = 12.42 * 3600.0, 60.0 * minutes
    bound = 0.5 * (math.pi * step / period) ** 2
    assert abs(1e3 * bound - stated_mm) < 0.05 * stated_mm
    times = np.arange(0.0, period, step)
    water = TidalWater(times, np.cos(2.0 * math.pi * times / period))
    middles = times[:-1] + 0.5 * step
    error = [water.at(t).point[2] - math.cos(2.0 * math.pi * t / period) for t in middles]
    assert 0.8 * bound < np.abs(error).max() < bound


def test_outside_the_series_there_is_no_level():
    water = TidalWater([0.0, 600.0], [1.0, 1.4])
    for time in (-1e-6, 600.1, math.nan):
        with pytest.raises(ValueError, match=r"run from 0\.0 to 600\.0"):
            water.at(time)
    with pytest.raises(ValueError, match="as the readings have"):
        water.at(np.datetime64("2026-06-01"))


def test_wrong_series_are_named():
    for times, levels, message in (
        ([0.0], [1.0], "at least two"),
        ([0.0, 1.0], [1.0, 2.0, 3.0], r"\(2,\) and \(3,\)"),
        ([0.0, 2.0, 1.0], [1.0, 1.0, 1.0], r"2\.0 before 1\.0"),
        ([0.0, 1.0], [1.0, math.nan], r"nan m at 1\.0"),
    ):
        with pytest.raises(ValueError, match=message):
            TidalWater(times, levels)
    with pytest.raises(ValueError, match="index of water"):
        TidalWater([0.0, 1.0], [1.0, 1.0], n_water=3.0)


@pytest.mark.parametrize("function", [trace, project, crossing_point])
def test_a_series_is_no_surface_and_the_error_says_what_is(function):
    water = TidalWater([0.0, 600.0], [1.0, 1.4])
    with pytest.raises(TypeError, match=r"got TidalWater.*water\.at\(time\)"):
        function(np.array([0.0, 0.0, 30.0]), np.array([0.0, 0.0, -1.0]), water)


def test_tensors_of_a_series_move_together():
    water = TidalWater([0.0, 600.0], [1.0, 1.4], n_water=torch.tensor(1.34)).to(torch.float64)
    assert water.n_water.dtype == water.at(300.0).n_water.dtype == torch.float64


LEVELS, TIMES = torch.tensor([1.0, 1.4, 1.1], dtype=torch.float64), np.array([0.0, 150.0, 1050.0, 1500.0])


def bent(levels: torch.Tensor) -> torch.Tensor:
    """Where rays of four photographs meet the water of a series of levels (3,), and how they go on."""
    water = TidalWater([0.0, 600.0, 1500.0], levels, slope_x=0.02).at(TIMES)
    ray = torch.tensor([[0.3, 0.1, -1.0]], dtype=torch.float64)
    path = trace(torch.zeros(4, 3, dtype=torch.float64) + torch.tensor([0.0, 0.0, 30.0]), ray / ray.norm(), water)
    return torch.cat([path.crossing, path.water_direction], dim=-1)


def test_a_tide_is_derived_by_its_readings():
    forward, backward = torch.func.jacfwd(bent)(LEVELS), torch.func.jacrev(bent)(LEVELS)
    torch.testing.assert_close(forward, backward, rtol=1e-14, atol=1e-15)
    # The level at a time is a mean of the readings about it, and all that follows hangs on the level alone.
    shares = torch.tensor([[1.0, 0.0, 0.0], [0.75, 0.25, 0.0], [0.0, 0.5, 0.5], [0.0, 0.0, 1.0]], dtype=torch.float64)
    by_level = forward[:, 2].sum(dim=-1)
    torch.testing.assert_close(forward[:, 2], by_level[:, None] * shares, rtol=1e-14, atol=1e-15)
    step = torch.tensor([0.0, 1e-3, 0.0], dtype=torch.float64)
    difference = (bent(LEVELS + step) - bent(LEVELS - step)) / 2e-3
    torch.testing.assert_close(forward[..., 1], difference, rtol=1e-9, atol=1e-10)


def test_tides_of_a_batch_are_those_of_each():
    batch = torch.stack([LEVELS, LEVELS + 0.2, 2.0 * LEVELS])
    each = torch.stack([bent(levels) for levels in batch])
    torch.testing.assert_close(torch.func.vmap(bent)(batch), each, rtol=1e-15, atol=1e-15)
    assert torch.autograd.gradcheck(bent, LEVELS.clone().requires_grad_())
