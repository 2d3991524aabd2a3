"""What neighbouring observations share: the design effect."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from slow_cases import slow

from survey.adjust.block.bundle import Solution, solve
from survey.adjust.block.prediction import apparent_rise_design, predict
from survey.adjust.block.priors import prior_of, priors_for
from survey.adjust.block.problem import Problem
from survey.adjust.clusters import PredictionChanges, cluster_design_effect, shared_variance, terrain_design_effect
from survey.photos.poses import TiePoints
from tests.block_survey import survey_of
from tests.drawn_block import draw_block

SIZES = [(1000, 800)] * 4
STD = np.array([0.5, 0.3])
NOISE_PX = 0.1
# Side of the squares of ground whose errors are alike [m]; a photograph shows 20 m.
SIDE_M = 1.5


def spread(rng, per_view: int) -> TiePoints:
    """As many points as observations, anywhere in four photographs."""
    view = np.repeat(np.arange(4), per_view)
    pixel = rng.uniform(0.0, (1000.0, 800.0), (len(view), 2))
    return TiePoints(np.zeros((len(view), 3)), np.arange(len(view)), view, pixel)


def test_independent_residuals_count_in_full(rng):
    ties = spread(rng, 1500)
    found = cluster_design_effect(ties, rng.normal(0.0, STD[0], (6000, 2)), STD, np.zeros(6000, int), SIZES)
    assert (found >= 1.0).all()
    assert found.max() < 1.3


@pytest.mark.parametrize("rho", [0.3, 1.0])
def test_shared_residuals_count_as_the_design_effect_of_their_squares(rng, rho):
    ties = spread(rng, 1500)
    # The same error for all in a square of 0.16 of the width.
    _, square = np.unique(np.column_stack([ties.view, np.floor(ties.pixel / 160.0)]), axis=0, return_inverse=True)
    square = square.ravel()
    shared = rng.normal(0.0, 1.0, (square.max() + 1, 2))[square]
    residuals = STD[0] * (np.sqrt(rho) * shared + np.sqrt(1.0 - rho) * rng.normal(size=shared.shape))
    found = cluster_design_effect(ties, residuals, STD, np.zeros(6000, int), SIZES)
    count = np.bincount(square)
    expected = 1.0 + (np.sum(count**2) / count.sum() - 1.0) * rho
    # 140 squares know a correlation to about a tenth.
    assert found[0] == pytest.approx(expected, rel=0.25)


def test_each_kind_has_a_factor_of_its_own(rng):
    ties, kind = spread(rng, 1000), np.tile([0, 1], 2000)
    residuals = rng.normal(0.0, 1.0, (4000, 2)) * STD[kind][:, None]
    cell = np.floor(ties.pixel / 160.0) @ [1.0, 7.0]
    shared = np.where(np.sin(12.9898 * cell + ties.view) > 0.0, 1.0, -1.0)
    residuals[kind == 1] = STD[1] * shared[kind == 1, None]
    found = cluster_design_effect(ties, residuals, STD, kind, SIZES)
    assert found[kind == 0].max() < 1.5
    assert found[kind == 1].min() > 5.0


def test_alone_in_their_squares_observations_share_nothing():
    ties = TiePoints(np.zeros((2, 3)), np.arange(2), np.array([0, 1]), np.full((2, 2), 50.0))
    np.testing.assert_array_equal(cluster_design_effect(ties, np.ones((2, 2)), STD, np.zeros(2, int), SIZES), 1.0)


def test_waves_are_shared_by_windows_beside_each_other_and_noise_only_by_those_that_overlap(rng):
    ties, waves = spread(rng, 3000), np.zeros((12000, 2))
    turned = 2.0 * np.pi / 200.0 * ties.pixel[:, 0] + rng.uniform(0.0, 7.0, 4)[ties.view]
    waves[:, 0] = 0.1 * np.sqrt(2.0) * np.sin(turned)
    # The same texture, found twice, 5 px apart.
    twice = replace(ties, view=np.tile(ties.view, 2), pixel=np.concatenate([ties.pixel, ties.pixel + 5.0]))
    noise, every = rng.normal(0.0, 0.2, (12000, 2)), np.ones(24000, dtype=bool)
    assert abs(shared_variance(twice, np.tile(noise, (2, 1)), every, 13.0)) < 0.001
    # Waves correlate by 0.85 over 24 px, along one of two coordinates.
    found = shared_variance(twice, np.tile(noise + waves, (2, 1)), every, 13.0)
    assert found == pytest.approx(0.85 * 0.5 * 0.1**2, abs=0.001)
    # Windows that are not seen, and two beside each other that are wrong, change nothing.
    found = np.tile(noise, (2, 1))
    found[:50], found[50:52] = np.nan, 3.0
    beside = twice.pixel.copy()
    beside[51] = beside[50] + (20.0, 0.0)
    assert abs(shared_variance(replace(twice, pixel=beside), found, every, 13.0)) < 0.001


def adjusted(seed: int, slope: float) -> tuple[Problem, Solution, list]:
    """A block over water whose surface has a slope of its own over each square of ground, the same in all views."""
    block = draw_block(seed, num_points=600, num_views=16, dry_share=0.0, num_control=0, height=20.0, depth=2.0)
    survey = survey_of(block)
    prior = prior_of(survey, 0.02)
    ties, water = survey.observations.ties, prior.state.water
    start = replace(prior.state, points=ties.start)
    rise_design = apparent_rise_design(start, ties)
    rng = np.random.default_rng([seed, 41])
    still = predict(prior.layout, start, ties, rise_design)
    sloping = predict(
        prior.layout, replace(start, water=replace(water, slope_x=water.slope_x + 0.01)), ties, rise_design
    )
    _, square = np.unique(np.floor(ties.start[:, :2] / SIDE_M), axis=0, return_inverse=True)
    slopes = slope * rng.standard_normal(square.max() + 1)[square.ravel()][ties.point]
    pixel = still + (sloping - still) * slopes[:, None] / 0.01 + NOISE_PX * rng.standard_normal(still.shape)
    ties = replace(ties, pixel=pixel)
    kind, given = np.zeros(len(pixel), dtype=int), np.array([np.nan])
    problem = Problem(prior.layout, ties, kind, priors_for(prior, ties), given, rise_design)
    lens = survey.views[0].lens
    return problem, solve(problem, start), [(lens.width, lens.height)] * len(survey.views)


def factor_of(seed: int, slope: float) -> float:
    problem, solution, sizes = adjusted(seed, slope)
    return terrain_design_effect(problem, solution, sizes, np.ones(len(problem.kind), dtype=bool))


@pytest.mark.parametrize("seed", [0, slow(1)])
def test_independent_errors_are_counted_once(seed):
    # The largest of three estimates, of up to some hundred squares each.
    assert 0.7 < factor_of(seed, 0.0) < 1.6


@pytest.mark.parametrize("turn_deg", [0.17, slow(0.0), slow(0.57), slow(1.7)])
def test_of_a_block_that_hardly_anything_orients_independent_errors_are_counted_once_from_wherever_it_starts(turn_deg):
    problem, solution, sizes = adjusted(1, 0.0)
    layout, state = problem.layout, solution.state
    std = problem.priors.std.copy()
    std[layout.first_pose :] = np.tile([3.0] * 3 + [np.radians(5.0)] * 3, len(layout.lens_of))
    problem = replace(problem, priors=replace(problem.priors, std=std))
    # About the vertical, where the water stays as it is: nothing but the priors tells.
    turn = Rotation.from_rotvec([0.0, 0.0, np.radians(turn_deg)]).as_matrix().T
    start = replace(state, centres=state.centres @ turn, points=state.points @ turn, rotations=state.rotations @ turn)
    found = terrain_design_effect(problem, solve(problem, start), sizes, np.ones(len(problem.kind), dtype=bool))
    # Derivatives after the last step and the covariance before it gave 3, and less than nothing in another block.
    assert 0.7 < found < 1.6


@pytest.mark.parametrize("seed", [0, slow(1)])
def test_what_ground_shares_is_found_where_it_exceeds_the_noise_of_single_observations(seed):
    # Points follow most of what a slope does; what is left is a part of the noise.
    assert factor_of(seed, 0.2) > 3.0


def test_what_parameters_take_of_a_square_is_counted(rng):
    # Of twelve parameters all observations depend on the first two, and those of a photograph on two more.
    count, num_parameters = 60, 12
    view = rng.integers(0, 5, count)
    columns = np.column_stack([np.zeros(count), np.ones(count), 2 + 2 * view, 3 + 2 * view]).astype(np.int64)
    design = rng.normal(size=(count, 2, 4))
    root = rng.normal(size=(num_parameters, num_parameters))
    weights, residuals = rng.uniform(1.0, 2.0, count), rng.normal(size=(count, 2))
    changes, square = rng.normal(size=(count, 2, 3)), rng.integers(0, 7, count)
    # Nothing of the first change shows in one square.
    changes[square == 3, :, 0] = 0.0
    covariance = 1e-3 * root @ root.T
    found = PredictionChanges(weights, residuals, changes, design, columns).ratios(square, covariance)
    whole = np.zeros((count, 2, num_parameters))
    np.put_along_axis(whole, columns[:, None], design, axis=2)
    for change, ratio in zip(np.moveaxis(changes, 2, 0), found, strict=True):
        squares = independent = 0.0
        for number in range(7):
            weighted = (weights[:, None] * change * (square == number)[:, None]).ravel()
            squares += float(weighted @ residuals.ravel()) ** 2
            taken = whole.reshape(-1, num_parameters).T @ weighted
            independent += float(weighted @ change.ravel()) - float(taken @ covariance @ taken)
        assert ratio == pytest.approx(squares / independent)


def test_too_little_ground_tells_nothing():
    problem, solution, sizes = adjusted(0, 0.0)
    wide = [(100 * width, 100 * height) for width, height in sizes]
    assert terrain_design_effect(problem, solution, wide, np.ones(len(problem.kind), dtype=bool)) == 1.0
