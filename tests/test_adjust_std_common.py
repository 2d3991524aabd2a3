"""The standard deviation that all points have in common: geometry says what each parameter does to heights."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from adjusted_block import drawn_adjustment
from block_survey import survey_of

from survey.adjust.result.std_common import shift_std, std_common
from tests.changed_survey import changed

GSD = 0.02


def along(found, step: dict[str, float]) -> np.ndarray:
    """A change of the parameters by their last names."""
    return np.array([step.get(name.rpartition(".")[2], 0.0) for name in found.covariance.names])


def of_change(step: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
    """The points of a drawn block, and their std where only this change of the parameters is uncertain."""
    block, found = drawn_adjustment(dry_share=0.0)
    survey = changed(survey_of(block), ties=None)
    change = along(found, step)
    found = replace(found, covariance=replace(found.covariance, matrix=np.outer(change, change)))
    wet = np.ones(len(found.points), dtype=bool)
    return found.points, std_common(found.points, wet, survey, found, GSD)


def test_cameras_and_water_that_rise_together_lift_every_height_as_much():
    _, std = of_change({"z": 0.025, "height_m": 0.025})
    np.testing.assert_allclose(std, 0.025, rtol=1e-3)


def test_an_error_of_the_index_grows_with_the_depth():
    points, std = of_change({"refractive_index": 0.001})
    deep = points[:, 2] < np.quantile(points[:, 2], 0.2)
    shallow = points[:, 2] > np.quantile(points[:, 2], 0.8)
    assert np.median(std[deep]) > 1.2 * np.median(std[shallow])


def test_no_height_is_exact():
    _, std = of_change({})
    assert (std > 0.0).all()


def test_without_an_adjustment_the_level_alone_keeps_heights_from_being_exact():
    block, found = drawn_adjustment(dry_share=0.3)
    survey = changed(survey_of(block), ties=None)
    wet = survey.water.depth(found.points) > 0.0
    std = std_common(found.points, wet, survey, None, GSD)
    assert np.isfinite(std).all()
    assert (std > 1e-3).all()
    assert np.median(std) < 0.2


def test_points_that_no_two_views_see_have_none():
    block, found = drawn_adjustment(dry_share=0.0)
    away = found.points + np.array([1000.0, 0.0, 0.0])
    std = std_common(away, np.ones(len(away), dtype=bool), changed(survey_of(block), ties=None), None, GSD)
    assert np.isnan(std).all()


def test_the_median_is_that_of_the_report():
    from survey.adjust.result.std_common import common_error

    block, found = drawn_adjustment(dry_share=0.0)
    survey = changed(survey_of(block), ties=None)
    std = std_common(found.points, np.ones(len(found.points), dtype=bool), survey, found, GSD)
    assert np.median(std) == pytest.approx(common_error(found, survey.water).typical, rel=0.35)


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
