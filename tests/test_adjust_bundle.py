"""The bundle adjustment: exact blocks, the elimination of points, covariance, and refusals."""

import math
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from survey.adjust.block.bundle import NotConvergedError, Solution, cost, levenberg_marquardt, rounding_of_cost, solve
from survey.adjust.block.normal_equations import huber_system, system_with
from survey.adjust.block.prediction import design_matrix, linearise, predict
from survey.adjust.block.problem import Planes, Priors, Problem, huber_loss, std_of_kinds
from survey.adjust.block.state import NUM_RELIEF, Layout, State
from survey.adjust.rounds import std_over_points
from survey.photos.poses import TiePoints
from tests.drawn_block import DrawnBlock, draw_block

WIDE_WATER = (2.0, 0.0, 0.0, 0.001)
SMALL = {"num_points": 120, "num_views": 14, "nadir_only": False, "dry_share": 0.4, "num_control": 6}


def truth_of(block: DrawnBlock) -> State:
    lens = block.lens
    parameters = [lens.focal[0], lens["cx"], lens["cy"], lens["k1"], lens["k2"], 0.0, lens["p1"], lens["p2"]]
    return State(
        block.plane,
        np.zeros(NUM_RELIEF),
        np.array([parameters]),
        np.array([camera.centre for camera in block.cameras]),
        np.array([camera.cam_from_local for camera in block.cameras]),
        block.points,
    )


def problem_of(block: DrawnBlock, *, water_std=WIDE_WATER, position_std: float = 1.0) -> Problem:
    """All unknowns nearly free but for the control points, which are known to a millimetre at their true places."""
    truth = truth_of(block)
    layout = Layout(np.zeros(len(block.cameras), dtype=np.int64), np.ones(1))
    poses = np.tile([position_std] * 3 + [np.inf] * 3, len(block.cameras))
    lens = [0.2 * truth.lenses[0, 0], 30.0, 30.0, 0.3, 0.3, 0.3, 0.01, 0.01]
    std = np.concatenate([np.maximum(water_std, 1e-9), np.full(NUM_RELIEF, 1e-9), lens, poses])
    point_std = np.full(block.points.shape, np.inf)
    point_std[block.control] = 0.001
    ties = TiePoints(block.points, block.point, block.view, block.pixel)
    kind = np.zeros(len(block.view), dtype=np.int64)
    rise_design = np.zeros((len(block.view), NUM_RELIEF))
    return Problem(layout, ties, kind, Priors(truth, std, point_std), np.array([np.nan]), rise_design)


def spoilt(block: DrawnBlock, rng) -> State:
    """No distortion, focal length 5 % off, poses decimetres, the level 0.5 m, and points on straight rays."""
    truth = truth_of(block)
    step = np.zeros(len(problem_of(block).layout))
    step[0] = 0.5
    step[7:15] = -truth.lenses[0]
    step[7:10] = 0.05 * truth.lenses[0, 0], -truth.lenses[0, 1] + 0.5 * block.lens.width, 0.0
    step[15:] = (rng.normal(size=(len(block.cameras), 6)) * ([0.3] * 3 + [0.003] * 3)).ravel()
    points = np.zeros(block.points.shape)
    points[:, 2] = np.maximum(truth.water.depth(block.points), 0.0) * (1.0 - 1.0 / truth.water.n_water)
    return truth.moved(problem_of(block).layout, step, points + rng.normal(0.0, 0.2, points.shape))


@pytest.mark.parametrize("seed", [1, 3, 8])
def test_an_exact_block_is_recovered_from_a_start_far_away(rng, seed):
    block = draw_block(seed, pixel_std=1e-4, **SMALL)
    problem, truth = problem_of(block), truth_of(block)
    found = solve(problem, spoilt(block, rng))
    assert found.std_px[0] <= 1e-3
    std = np.sqrt(np.diag(found.covariance))
    pull = Priors(truth, problem.priors.std, problem.priors.point_std).deviation(problem.layout, found.state)
    # Pixels are far better than the least standard deviation that is assumed of them, 1e-3 px.
    assert np.abs(pull / std).max() < 1.0
    # The unit is what the covariance says: far below what the start was off by.
    assert std[0] < 0.03
    assert std[7] < 1e-3 * truth.lenses[0, 0]
    assert np.abs(found.state.centres - truth.centres).max() < 0.02


def test_points_are_found_on_either_side_of_the_water(rng):
    block = draw_block(3, pixel_std=1e-4, **SMALL)
    start = spoilt(block, rng)
    # Half of all points start on the wrong side.
    points = start.points.copy()
    height = start.water.height(*points[:, :2].T)
    points[::2, 2] = 2.0 * height[::2] - points[::2, 2]
    found = solve(problem_of(block), replace(start, points=points))
    assert np.median(np.abs(found.state.points - block.points)) < 0.01
    depth, true = found.state.water.depth(found.state.points), block.plane.depth(block.points)
    assert ((depth > 0.0) == (true > 0.0)).mean() > 0.98


def test_held_parameters_stay_and_points_go_where_parameters_that_cannot_move_let_them():
    block = draw_block(3, pixel_std=0.3, **SMALL)
    problem, truth = problem_of(block), truth_of(block)
    stiff = replace(problem, priors=replace(problem.priors, std=np.full_like(problem.priors.std, 1e-9)))
    start = replace(truth, points=truth.points + 0.05)
    found, expected = solve(replace(stiff, holds_parameters=True), start), solve(stiff, start)
    assert np.array_equal(found.state.centres, truth.centres)
    assert np.array_equal(found.state.lenses, truth.lenses)
    assert np.abs(found.state.points - expected.state.points).max() < 1e-5
    assert np.abs(found.state.points - start.points).max() > 0.01


def test_a_problem_of_some_points_has_their_residuals_and_steps():
    block = draw_block(3, pixel_std=0.3, **SMALL)
    normal = np.tile([0.1, -0.2, 1.0], (len(block.points), 1))
    planes = Planes(normal, np.sum(normal * block.points, axis=1) + 0.02, np.full(len(block.points), 400.0))
    problem, truth, std_px = problem_of(block), truth_of(block), np.array([0.3])
    problem = replace(problem, holds_parameters=True, priors=replace(problem.priors, planes=planes))
    state = replace(truth, points=truth.points + 0.05, shift=np.zeros(3))
    points = np.array([0, 3, 4, len(block.points) - 1])
    part, of_part = problem.of_points(points), replace(state, points=state.points[points])
    observations = problem.observations_of(points)
    assert set(problem.ties.point[observations]) == set(points)
    np.testing.assert_array_equal(part.residuals(of_part), problem.residuals(state)[observations])
    steps, expected = (
        huber_system(each, at, std_px, np.ones(len(each.kind))).point_steps(np.zeros(len(problem.priors.std)))
        for each, at in ((part, of_part), (problem, state))
    )
    # The same sums in float64, of arrays of another length.
    np.testing.assert_allclose(steps, expected[points], rtol=1e-9)


def dense(problem: Problem, solution: Solution) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrix of all unknowns, parameters first, and their right side, at the weights of a solution."""
    state, ties, priors = solution.state, problem.ties, problem.priors
    linear = linearise(problem.layout, state, ties, problem.rise_design)
    size = len(problem.layout)
    design = np.zeros((2 * len(ties.view), size + 3 * len(ties)))
    design[:, :size] = design_matrix(problem.layout, ties.view, linear.by_parameters).toarray()
    for row, point in enumerate(ties.point):
        design[2 * row : 2 * row + 2, size + 3 * point : size + 3 * point + 3] = linear.by_point[row]
    weights = np.repeat(solution.weights, 2)
    precision = np.concatenate([priors.std, priors.point_std.ravel()]) ** -2.0
    pull = np.concatenate([priors.deviation(problem.layout, state), (state.points - priors.state.points).ravel()])
    normal = design.T @ (weights[:, None] * design) + np.diag(precision)
    right = design.T @ (weights * (ties.pixel - linear.pixels).ravel()) - precision * pull
    planes = priors.planes
    if planes is not None:
        off = np.zeros((len(ties), len(normal)))
        off[:, problem.layout.shift] = -planes.normal
        for number, each in enumerate(planes.normal):
            off[number, size + 3 * number : size + 3 * number + 3] = each
        normal += off.T @ (planes.precision[:, None] * off)
        distances = np.sum(planes.normal * (state.points - state.shift), axis=1) - planes.height
        right -= off.T @ (planes.precision * distances)
    return normal, right


def on_planes(problem: Problem, rng: np.random.Generator) -> Problem:
    """The problem with a plane of an earlier survey, which is off, through every other point."""
    points, count = problem.priors.state.points, len(problem.ties)
    normal = np.column_stack([rng.normal(0.0, 0.3, (count, 2)), np.ones(count)])
    height = np.sum(normal * (points - [0.1, -0.05, 0.15]), axis=1) + rng.normal(0.0, 0.03, count)
    planes = Planes(normal, height, np.where(np.arange(count) % 2, 0.03**-2, 0.0))
    layout = replace(problem.layout, has_ground=True)
    std = np.insert(problem.priors.std, layout.shift.start, [0.1, 0.1, 0.05])
    state = replace(problem.priors.state, shift=np.zeros(3))
    return replace(problem, layout=layout, priors=replace(problem.priors, state=state, std=std, planes=planes))


@pytest.fixture(scope="module", params=["alone", "on planes"])
def solved(request) -> tuple[Problem, Solution]:
    block = draw_block(3, **SMALL | {"num_points": 60, "num_views": 8}, pixel_std=0.3)
    problem = problem_of(block, position_std=0.05)
    if request.param == "on planes":
        problem = on_planes(problem, np.random.default_rng(5))
    return problem, solve(problem, problem.priors.state)


def test_the_covariance_is_the_inverse_of_the_normal_matrix_of_all_unknowns(solved):
    problem, solution = solved
    normal, _ = dense(problem, solution)
    scale = 1.0 / np.sqrt(np.diag(normal))
    expected = np.linalg.inv(normal * np.outer(scale, scale)) * np.outer(scale, scale)
    expected = expected[: len(problem.layout), : len(problem.layout)]
    std, expected_std = np.sqrt(np.diag(solution.covariance)), np.sqrt(np.diag(expected))
    # The last step changes the robust weights by a little.
    np.testing.assert_allclose(std, expected_std, rtol=2e-2)
    difference = (solution.covariance - expected) / np.outer(expected_std, expected_std)
    assert np.abs(difference).max() < 2e-2


def test_the_eliminated_system_has_the_step_of_the_whole_one(solved):
    problem, solution = solved
    normal, right = dense(problem, solution)
    size = len(problem.layout)
    mixed, own = normal[:size, size:], normal[size:, size:]
    schur = normal[:size, :size] - mixed @ np.linalg.solve(own, mixed.T)
    system = huber_system(problem, solution.state, solution.std_px, np.ones(len(problem.kind)))
    scale = 1.0 / np.sqrt(np.diag(schur))
    # Points that are damped by 1e-13 of their own matrices.
    np.testing.assert_allclose(
        system.normal.dense() * np.outer(scale, scale), schur * np.outer(scale, scale), atol=1e-5
    )
    reduced = right[:size] - mixed @ np.linalg.solve(own, right[size:])
    np.testing.assert_allclose(system.right_side * scale, reduced * scale, atol=1e-3)
    step = 1e-3 * np.sqrt(np.diag(solution.covariance))
    points = np.linalg.solve(own, right[size:] - mixed.T @ step).reshape(-1, 3)
    np.testing.assert_allclose(system.point_steps(step), points, atol=1e-6)


def test_at_the_solution_no_parameter_moves_by_more_than_a_fifth_of_its_standard_deviation(solved):
    _, solution = solved
    step = np.linalg.solve(solution.system.normal.dense(), solution.system.right_side)
    assert np.abs(step / np.sqrt(np.diag(solution.covariance))).max() < 0.2


@dataclass(frozen=True)
class WorseElsewhere(Problem):
    """A problem whose residuals are of some size [px] at the state of its priors and far larger at any other."""

    size_px: float = 1.0

    def residuals(self, state: State) -> np.ndarray:
        is_there = np.array_equal(state.centres, self.priors.state.centres) and np.array_equal(
            state.points, self.priors.state.points
        )
        return np.full_like(self.ties.pixel, self.size_px if is_there else 10.0 * self.size_px)


def stuck(size_px: float) -> WorseElsewhere:
    """A noisy block at its true state, which is not the minimum, from where every step raises the cost."""
    problem = problem_of(draw_block(3, pixel_std=0.3, **SMALL))
    return WorseElsewhere(**{each.name: getattr(problem, each.name) for each in fields(problem)}, size_px=size_px)


def test_where_no_step_lowers_the_cost_short_of_the_minimum_the_adjustment_is_refused_with_numbers():
    problem = stuck(1.0)
    one, std_px = np.ones(len(problem.kind)), np.array([0.3])
    decrement = huber_system(problem, problem.priors.state, std_px, one).decrement()
    assert decrement > 1.0
    value = cost(problem, problem.priors.state, std_px)
    with pytest.raises(NotConvergedError, match=rf"no step lowers .* {value:.6g}, though .* predict {decrement:.3g} "):
        levenberg_marquardt(problem, problem.priors.state, std_px, one)


def test_a_decrease_that_would_not_show_in_the_cost_is_the_minimum():
    problem = stuck(1e13)
    one, std_px = np.ones(len(problem.kind)), np.array([0.3])
    state, system = levenberg_marquardt(problem, problem.priors.state, std_px, one)
    assert state is problem.priors.state
    value = cost(problem, state, std_px)
    assert value + system.decrement() == pytest.approx(value, rel=1e-12)
    assert 1.0 < system.decrement() < rounding_of_cost(problem, value)


@pytest.mark.parametrize("seed", range(3))
def test_the_cost_is_exact_to_the_bound_on_its_rounding(seed):
    rng = np.random.default_rng(seed)
    block = draw_block(3, pixel_std=0.3, **SMALL)
    problem, std_px = problem_of(block), np.array([0.3])
    state = spoilt(block, rng)
    length = np.linalg.norm(problem.residuals(state), axis=1) / std_px[0]
    deviation = problem.priors.deviation(problem.layout, state) / problem.priors.std
    of_points = ((state.points - problem.priors.state.points) / problem.priors.point_std).ravel()
    exact = math.fsum([*huber_loss(length), *deviation**2, *of_points**2])
    found = cost(problem, state, std_px)
    assert abs(found - exact) <= rounding_of_cost(problem, exact)
    # Far less than a decrease that ends the iteration.
    assert rounding_of_cost(problem, float(2 * len(problem.kind))) < 1e-6


def test_the_standard_deviation_of_pixels_is_that_of_the_noise():
    block = draw_block(5, num_points=200, num_views=16, pixel_std=0.3)
    problem = problem_of(block, position_std=0.02)
    found = solve(problem, problem.priors.state)
    assert found.std_px[0] == pytest.approx(0.3, rel=0.06)


def test_parameters_take_some_of_what_residuals_would_tell():
    block = draw_block(3, num_points=25, num_views=8, dry_share=0.3, pixel_std=0.3)
    problem = problem_of(block, position_std=5.0)
    found = solve(problem, problem.priors.state)
    # 48 for poses alone, of two for each observation less three for each point.
    spare = 2 * len(block.view) - 3 * len(block.points)
    assert spare < 200
    assert found.std_px[0] == pytest.approx(0.3, rel=0.25)


def test_a_stated_standard_deviation_of_pixels_is_kept():
    block = draw_block(5, num_points=60, num_views=8, pixel_std=0.3)
    problem = replace(problem_of(block), given_std_px=np.array([0.7]))
    assert std_of_kinds(problem, np.zeros((len(block.view), 2)), 0.0)[0] == 0.7


def test_factors_on_variances_widen_the_covariance():
    block = draw_block(3, **SMALL | {"num_points": 60}, pixel_std=0.3)
    problem = problem_of(block)
    alone = solve(problem, problem.priors.state)
    wider = solve(problem, problem.priors.state, variance_factor=np.full(len(block.view), 4.0))
    np.testing.assert_allclose(np.median(wider.weights), 0.25 * np.median(alone.weights), rtol=0.05)
    assert np.sqrt(wider.covariance[7, 7] / alone.covariance[7, 7]) > 1.2
    # Priors and control points stay as good as they were; at one state, since the level is a non-linear unknown.
    same = system_with(problem, alone.state, 0.25 * alone.weights).normal.inverse
    assert np.sqrt(np.diag(same) / np.diag(alone.covariance)).max() < 2.0 + 1e-6


@pytest.mark.parametrize("short_of", [0.9, 0.6])
def test_depth_and_level_are_found_along_their_curved_valley(short_of):
    # Straight down over a bed that is all wet, depth and level move together at nearly the same cost. With points that
    # follow a step in straight lines, both starts end 37 units of variance above the minimum, 0.7 m off.
    block = draw_block(
        14, num_points=200, num_views=14, nadir_only=True, dry_share=0.0, num_control=0, pixel_std=0.03, depth=1.6,
        height=16.0,
    )  # fmt: skip
    problem = problem_of(block, water_std=(50.0, 1e-9, 1e-9, 0.001), position_std=0.05)
    true = problem.priors.state
    low = np.zeros(len(problem.layout))
    low[0] = -short_of * 1.6
    shallow = true.moved(problem.layout, low, np.zeros(block.points.shape))
    costs = [cost(problem, solve(problem, start).state, np.array([0.03])) for start in (true, shallow)]
    # Each ends within a fifth of a standard deviation of the minimum.
    assert abs(costs[1] - costs[0]) < 1.0


def test_the_scale_of_a_block_is_as_uncertain_as_positions_leave_it():
    block = draw_block(4, num_points=400, num_views=12, dry_share=1.0, num_control=0, pixel_std=0.01)
    problem = problem_of(block, position_std=3.0)
    solution = solve(problem, problem.priors.state)
    centres = problem.priors.state.centres
    arms = centres - centres.mean(axis=0)
    by_scale = np.zeros(len(problem.layout))
    by_scale[15:].reshape(-1, 6)[:, :3] = arms / np.sum(arms**2)
    # Nothing but the positions says how long a metre is: of n of them, s / sqrt(sum of squared arms).
    expected = 3.0 / np.sqrt(np.sum(arms**2))
    assert np.sqrt(by_scale @ solution.covariance @ by_scale) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("num_weak", [1, 10])
def test_points_of_photographs_taken_from_one_place_do_not_stop_the_others(num_weak):
    problem = from_one_place(num_weak)
    start = problem.priors.state
    solution = solve(problem, start)
    assert cost(problem, solution.state, solution.std_px) < 0.9 * cost(problem, start, solution.std_px)
    # Their heights are unknown, and do not count in the mean of all.
    others = from_one_place(0)
    stds = [std_over_points(each.system, each.covariance) for each in (solution, solve(others, others.priors.state))]
    assert stds[0] == pytest.approx(stds[1], rel=0.2)


def from_one_place(num_weak: int) -> Problem:
    """A block of which two photographs are taken a millimetre apart, and alone show some points."""
    block = draw_block(4, num_points=200, num_views=12, dry_share=0.5, num_control=4, pixel_std=0.3)
    problem = problem_of(block, position_std=0.05)
    true, ties = problem.priors.state, problem.ties
    centres, rotations = true.centres.copy(), true.rotations.copy()
    centres[1], rotations[1] = centres[0] + (0.001, 0.0, 0.0), rotations[0]
    rng = np.random.default_rng(0)
    below = np.column_stack([rng.uniform(-3.0, 3.0, (num_weak, 2)), np.full(num_weak, -centres[0, 2] - 1.0)])
    points = np.concatenate([true.points, centres[0] + below])
    more = len(true.points) + np.repeat(np.arange(num_weak), 2)
    point, view = np.append(ties.point, more), np.append(ties.view, np.tile([0, 1], num_weak))
    state = replace(true, centres=centres, rotations=rotations, points=points)
    rise_design = np.zeros((len(point), NUM_RELIEF))
    pixel = predict(problem.layout, state, TiePoints(points, point, view, np.zeros((len(point), 2))), rise_design)
    priors = replace(
        problem.priors,
        state=state,
        point_std=np.concatenate([problem.priors.point_std, np.full((num_weak, 3), np.inf)]),
    )
    noisy = TiePoints(points, point, view, pixel + 0.3 * rng.standard_normal(pixel.shape))
    return replace(
        problem, ties=noisy, kind=np.zeros(len(point), dtype=np.int64), rise_design=rise_design, priors=priors
    )


def test_a_photograph_that_nothing_ties_is_refused_in_words():
    block = draw_block(3, **SMALL)
    problem = problem_of(block)
    ties = problem.ties.only(problem.ties.view != 5)
    std = problem.priors.std.copy()
    std[problem.layout.first_pose + 30 : problem.layout.first_pose + 36] = np.inf
    # Numbers of points change: none is known.
    priors = Priors(replace(truth_of(block), points=ties.start), std, np.full((len(ties), 3), np.inf))
    count = len(ties.view)
    lost = Problem(
        problem.layout, ties, np.zeros(count, int), priors, problem.given_std_px, np.zeros((count, NUM_RELIEF))
    )
    with pytest.raises(NotConvergedError, match="photograph"):
        solve(lost, priors.state)
