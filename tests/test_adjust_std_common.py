"""The standard deviation that all heights share: what geometry says of each parameter, and a Monte Carlo."""

import math
from dataclasses import replace

import numpy as np
import pytest

from survey.adjust.block.prediction import linearise, predict
from survey.adjust.block.priors import parameters_of
from survey.adjust.block.state import Layout, State
from survey.adjust.result.adjustment import Residuals
from survey.adjust.result.parts import _places_of_mean, common_error
from survey.adjust.result.std_common import place_jacobian, shift_std, std_common
from tests.block_survey import drawn_adjustment, survey_of
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


def test_in_plan_it_is_what_all_poses_that_move_along_one_axis_move_places():
    block, found = drawn_adjustment(dry_share=0.0)
    step = along(found, {"x": 0.02})
    found = replace(found, covariance=replace(found.covariance, matrix=np.outer(step, step)))
    survey, wet = changed(survey_of(block), ties=None), np.ones(len(found.points), dtype=bool)
    of_height, in_plan = np.empty((2, len(wet)), dtype=np.float32)
    std_common(found.points, wet, survey, found, GSD, (of_height, in_plan))
    # The root mean square over both axes; level water moves nothing.
    np.testing.assert_allclose(in_plan, 0.02 / math.sqrt(2.0), rtol=1e-3)
    assert of_height.max() < 1e-3
    np.testing.assert_array_equal(of_height, std_common(found.points, wet, survey, found, GSD))


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
    from survey.adjust.result.parts import common_error

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
    found = shift_std(grid(lambda x, y: slope[0] * x + slope[1] * y), std, 0.05)
    inner = np.median(found)
    assert inner == pytest.approx(math.hypot(*slope) * std, rel=0.02)


def test_over_a_flat_bed_it_is_nothing():
    assert shift_std(grid(lambda x, y: 0.0 * x), 2.0, 0.05).max() == 0.0


def test_over_ripples_it_is_what_shifted_ripples_differ_by():
    ripples = grid(lambda x, y: 0.1 * np.sin(2.0 * math.pi * x / 3.0))
    found = np.sqrt(np.mean(shift_std(ripples, 2.0, 0.05) ** 2))
    rng = np.random.default_rng(1)
    x, shift = rng.uniform(0.0, 30.0, 20000), 2.0 * rng.standard_normal(20000)
    wanted = np.std(0.1 * (np.sin(2.0 * math.pi * (x + shift) / 3.0) - np.sin(2.0 * math.pi * x / 3.0)))
    assert found == pytest.approx(wanted, rel=0.35)


def _with(found, change: np.ndarray):
    return replace(found, covariance=replace(found.covariance, matrix=np.outer(change, change)))


def test_cameras_and_water_that_rise_together_lift_every_height_as_much():
    block, found = drawn_adjustment()
    rise = along(found, {"z": 0.025, "height_m": 0.025})
    error = common_error(_with(found, rise), block.plane)
    assert error.mean == pytest.approx(0.025, rel=1e-6)
    assert error.typical == pytest.approx(0.025, rel=1e-6)
    assert error.num_places > 20


def test_cameras_that_rise_over_dry_ground_lift_it_as_much():
    _, found = drawn_adjustment(dry_share=0.4)
    error = common_error(_with(found, along(found, {"z": 0.01})), None)
    assert error.mean == pytest.approx(0.01, rel=1e-6)


def test_errors_of_single_positions_average_out_over_the_area():
    block, found = drawn_adjustment(num_views=30)
    alone = np.diag(along(found, {"z": 0.02}) ** 2)
    error = common_error(replace(found, covariance=replace(found.covariance, matrix=alone)), block.plane)
    assert error.mean < 0.6 * error.typical


def test_an_error_of_the_index_scales_depths_seen_from_above():
    block, found = drawn_adjustment(nadir_only=True, dry_share=0.0)
    water = block.plane
    change = along(found, {"refractive_index": 0.001})
    ties = _places_of_mean(found)
    rise = place_jacobian(found, water, ties)[:, 2] @ change
    # Straight down the true depth is the apparent one times n; slanting rays add some more.
    expected = -0.001 / block.water[3] * water.depth(ties.start)
    assert np.median(rise / expected) == pytest.approx(1.0, abs=0.25)


@pytest.mark.slow
def test_the_standard_deviation_is_that_of_heights_under_random_parameters():
    block, found = drawn_adjustment(4)
    water = block.plane
    x, y = found.covariance.water_point
    water = replace(water, point=(x, y, float(water.height(x, y))))
    ties = _places_of_mean(found)
    layout = Layout(found.poses.lens_of, np.array([1.0]))
    lenses = np.array([parameters_of(lens) for lens in found.lenses])
    true = State(water, np.zeros(3), lenses, found.poses.centres, found.poses.rotations, ties.start)
    rise_design = np.zeros((len(ties.view), 3))
    seen = replace(ties, pixel=predict(layout, true, ties, rise_design))
    rng = np.random.default_rng(8)
    root = np.linalg.cholesky(found.covariance.matrix)
    heights = []
    for _ in range(400):
        step = root @ rng.standard_normal(len(root))
        moved = true.moved(layout, np.insert(step, 4, np.zeros(3)), np.zeros_like(ties.start))
        for _ in range(3):
            linear = linearise(layout, moved, seen, rise_design)
            miss = seen.pixel - linear.pixels
            points = moved.points.copy()
            for number in range(len(ties)):
                mine = ties.point == number
                points[number] += np.linalg.lstsq(linear.by_point[mine].reshape(-1, 3), miss[mine].ravel())[0]
            moved = replace(moved, points=points)
        heights.append(moved.points[:, 2] - true.points[:, 2])
    heights = np.array(heights)
    error = common_error(found, water)
    # 400 draws know a standard deviation to 3.5 %.
    assert error.mean == pytest.approx(heights.mean(axis=1).std(), rel=0.12)
    assert error.typical == pytest.approx(np.median(heights.std(axis=0)), rel=0.12)


def test_a_block_without_points_that_three_views_show_has_no_common_error():
    _, found = drawn_adjustment()
    none = np.zeros(0, dtype=np.int64)
    empty = replace(found, residuals=Residuals(none, np.zeros((0, 2)), np.zeros((0, 2)), none))
    assert common_error(empty, None) is None
