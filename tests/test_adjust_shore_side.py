"""The covariance of a free level where points lie just above it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from survey.adjust.bundle import Priors, Problem, Solution, inverse, system_at
from survey.adjust.prediction import relief_sides
from survey.adjust.shore_side import covariance_over_shore
from survey.adjust.state import POSE, RELIEF, with_parameters
from tests.block_state import state_of
from tests.drawn_block import draw_block

PIXEL_STD = 0.2


def solved_at(level: float, **settings) -> tuple[Problem, Solution]:
    """A block as it is, but for its level [m], which is free; positions are good to decimetres."""
    block = draw_block(
        5, num_points=150, num_views=12, nadir_only=False, num_control=0, height=25.0, depth=1.5, **settings
    )
    layout, state, ties = state_of(block)
    parameters = state.water_parameters()
    parameters[0] += level
    state = replace(state, water=with_parameters(state.water, parameters))
    std = np.full(len(layout), np.inf)
    std[:4], std[4 : 4 + RELIEF] = (80.0, 1e-9, 1e-9, 1e-3), 1e-9
    std[layout.first_lens : layout.first_pose] = np.tile([10.0, 5.0, 5.0, 0.1, 0.1, 0.1, 0.01, 0.01], 2)
    std[layout.first_pose :] = np.tile([0.3, 0.3, 0.3, np.inf, np.inf, np.inf], len(block.cameras))
    assert layout.first_pose + POSE * len(block.cameras) == len(layout)
    kind, std_px = np.zeros(len(ties.view), dtype=np.int64), np.array([PIXEL_STD])
    priors = Priors(state, std, np.full(ties.start.shape, np.inf))
    problem = Problem(layout, ties, kind, priors, std_px, relief_sides(state, ties))
    system = system_at(problem, state, std_px)
    weights = np.full(len(kind), PIXEL_STD**-2.0)
    return problem, Solution(state, inverse(system.normal), problem.residuals(state), weights, std_px, system)


def level_std(covariance: np.ndarray) -> float:
    return float(np.sqrt(covariance[0, 0]))


def test_a_level_that_a_few_dry_points_hold_is_as_uncertain_as_without_them():
    _, wet = solved_at(0.0, dry_share=0.0)
    depths = np.sort(wet.state.water.depth(wet.state.points))
    # A twentieth of the points come out of the water.
    problem, seen = solved_at(-float(depths[len(depths) // 20]), dry_share=0.0)
    assert level_std(seen.covariance) < 0.6 * level_std(wet.covariance)
    # A lower level is told by shallower water, by a little less.
    assert level_std(covariance_over_shore(problem, seen)) == pytest.approx(level_std(wet.covariance), rel=0.35)


@pytest.mark.parametrize("dry_share", [0.0, 0.4])
def test_where_no_point_is_near_the_surface_or_many_are_far_above_it_the_covariance_stays(dry_share):
    problem, solution = solved_at(0.0, dry_share=dry_share)
    found = covariance_over_shore(problem, solution)
    assert level_std(found) == pytest.approx(level_std(solution.covariance), rel=0.25)


def test_the_mean_height_of_points_follows_parameters_as_its_derivative_says():
    _, solution = solved_at(0.0, dry_share=0.4)
    system, rng = solution.system, np.random.default_rng(1)
    step = rng.standard_normal(len(solution.covariance)) * np.sqrt(np.diag(solution.covariance))
    moved = system.point_steps(step) - system.point_steps(np.zeros_like(step))
    assert float(moved[:, 2].mean()) == pytest.approx(float(system.heights_by_parameters() @ step), rel=1e-9)
