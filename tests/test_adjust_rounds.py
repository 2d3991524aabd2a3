"""Rounds of an adjustment: outliers, blunders of positions, positions of unknown accuracy."""

from dataclasses import replace

import numpy as np
import pytest

from survey.adjust import rounds
from survey.adjust.block.bundle import Solution
from survey.adjust.block.normal_equations import huber_system
from survey.adjust.block.prediction import apparent_rise_design
from survey.adjust.block.problem import Priors, Problem
from survey.adjust.block.state import NUM_POSE, NUM_RELIEF, with_parameters
from survey.adjust.refine import adjust_survey
from survey.adjust.rounds import covariance_over_shore
from survey.folder.pose_priors import PosePrior
from tests.block_survey import pose_errors, rms, state_of, survey_of
from tests.changed_survey import changed
from tests.drawn_block import draw_block

PIXEL_STD = 0.2


def without_position_std(survey):
    """The survey with GPS of which nobody says how good it is."""
    priors = {
        name: PosePrior(prior.position, None, None, "GPS EXIF") for name, prior in survey.observations.priors.items()
    }
    return changed(survey, priors=priors)


def test_with_outliers_to_the_last_round_residuals_are_those_of_the_observations_used():
    block = draw_block(4, num_points=150, num_views=16, dry_share=0.3, wrong=0.3)
    found = adjust_survey(survey_of(block), use_windows=False)
    assert found.statistics.num_left_out > 0
    assert len(found.residuals.px) == len(found.residuals.view) == sum(found.statistics.num_observations.values())
    assert len(found.points) == found.statistics.num_points == found.residuals.point.max() + 1
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert rms(positions) < 0.05


def test_a_blunder_of_five_metres_is_named_and_changes_nothing():
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.3)
    survey = survey_of(block)
    name = survey.views[7].name
    prior = survey.observations.priors[name]
    without = changed(survey, priors={k: v for k, v in survey.observations.priors.items() if k != name})
    wrong = replace(prior, position=prior.position + np.array([5.0, 0.0, 0.0]))
    spoilt = changed(survey, priors={**survey.observations.priors, name: wrong})
    found, expected = (adjust_survey(each, use_windows=False) for each in (spoilt, without))
    assert [warning for warning in found.warnings if name in warning and "contradicts" in warning]
    assert not expected.warnings
    # Both end within the tolerance of the adjustment, which is a share of the standard deviation.
    assert (np.abs(found.poses.centres - expected.poses.centres) < 0.3 * expected.poses.position_std).all()
    np.testing.assert_allclose(found.poses.position_std, expected.poses.position_std, rtol=0.1)


def test_positions_that_structure_from_motion_contradicts_count_again_where_the_adjusted_block_bears_them_out():
    """One camera's lens is 5 % off on straight rays, so that its positions seem wrong; one of them is wrong."""
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.3)
    survey = survey_of(block)
    names = [view.name for view in survey.views[::2]]
    given = dict(survey.observations.priors)
    off = replace(given[names[2]], position=given[names[2]].position + np.array([0.0, 4.0, 0.0]))
    rejected = {name: (off if name == names[2] else given[name]).without_position() for name in names}
    found = adjust_survey(changed(survey, priors={**given, **rejected}), use_windows=False)
    expected = adjust_survey(changed(survey, priors={**given, names[2]: off}), use_windows=False)
    named = [warning for warning in found.warnings if "contradicts" in warning]
    assert len(named) == 1
    assert [name for name in given if name in named[0]] == [names[2]]
    assert (np.abs(found.poses.centres - expected.poses.centres) < 0.3 * expected.poses.position_std).all()
    np.testing.assert_allclose(found.poses.position_std, expected.poses.position_std, rtol=0.1)


def test_the_standard_deviation_of_positions_is_found_where_nothing_is_said_of_it():
    block = draw_block(6, num_points=150, num_views=36, dry_share=0.3, position_std=(0.6, 0.6, 1.2))
    found = adjust_survey(without_position_std(survey_of(block)), use_windows=False)
    true = np.array([camera.centre for camera in block.cameras])
    drawn = np.std(block.positions - true, axis=0)
    np.testing.assert_allclose(found.statistics.gps_std_m, drawn, rtol=0.35)
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    assert np.mean(np.abs(positions) < 1.96 * found.poses.position_std) > 0.8


def test_a_third_of_the_photographs_without_gps_takes_their_place_from_the_others():
    block = draw_block(5, num_points=150, num_views=18, dry_share=0.3)
    survey = survey_of(block)
    priors = {name: prior for number, (name, prior) in enumerate(survey.observations.priors.items()) if number % 3}
    found = adjust_survey(changed(survey, priors=priors), use_windows=False)
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    lost = np.arange(len(positions)) % 3 == 0
    assert rms(positions[lost]) < 0.1
    assert np.mean(np.abs(positions[lost]) < 1.96 * found.poses.position_std[lost]) > 0.8
    assert np.isfinite(found.poses.position_std).all()


def test_a_mark_in_a_photograph_that_does_not_show_the_point_is_left_out():
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.35, num_control=5)
    survey = survey_of(block)
    mark, *rest = survey.observations.control.marks
    wrong = replace(mark, pixel=(mark.pixel[0] + 60.0, mark.pixel[1] - 40.0))
    spoilt = changed(survey, control=replace(survey.observations.control, marks=(wrong, *rest)))
    found = adjust_survey(spoilt, use_windows=False)
    marks = {point.name: point.num_marks for point in found.control}
    whole = {point.name: point.num_marks for point in adjust_survey(survey, use_windows=False).control}
    assert marks == whole | {mark.point: whole[mark.point] - 1}
    assert max(abs(v) for point in found.control for v in point.residual_m) < 0.05


def test_control_points_fix_the_datum():
    block = draw_block(3, num_points=200, num_views=18, dry_share=0.35, num_control=6, position_std=(0.5, 0.5, 0.5))
    survey = survey_of(block)
    shift = np.array([2.0, -1.0, 1.5])
    moved = {
        name: replace(prior, position=prior.position + shift, position_std=None, source="GPS EXIF")
        for name, prior in survey.observations.priors.items()
    }
    found = adjust_survey(changed(survey, priors=moved), use_windows=False)
    positions, _ = pose_errors(block, found.poses.centres, found.poses.rotations)
    # The points lie on a bank at one side, known to a centimetre.
    assert np.abs(positions.mean(axis=0)).max() < 0.15
    assert np.mean(np.abs(positions) < 2.6 * found.poses.position_std) > 0.9
    assert max(abs(v) for point in found.control for v in point.residual_m) < 0.04


def test_a_photograph_with_a_single_match_stays_where_it_was_and_is_named():
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.3)
    survey = survey_of(replace(block, control=block.control[:0]))
    keep = (survey.observations.ties.view != 5) | (np.cumsum(survey.observations.ties.view == 5) == 1)
    found = adjust_survey(changed(survey, ties=survey.observations.ties.only(keep)), use_windows=False)
    (warning,) = found.warnings
    assert survey.views[5].name in warning
    assert "fewer than 6 matches" in warning
    assert found.poses.rotation_std_deg[5].max() > 1.0
    assert np.delete(found.poses.rotation_std_deg, 5, axis=0).max() < 0.2
    np.testing.assert_allclose(found.poses.centres[5], block.positions[5], atol=0.05)


def test_residuals_are_of_what_is_used_where_rounds_end_before_nothing_changes(monkeypatch):
    monkeypatch.setattr(rounds, "_ROUNDS", 1)
    block = draw_block(3, num_points=150, num_views=18, dry_share=0.3, wrong=0.03)
    found = adjust_survey(survey_of(block), use_windows=False)
    assert len(found.residuals.px) == len(found.residuals.view) == sum(found.statistics.num_observations.values())
    assert len(found.points) == found.statistics.num_points == found.residuals.point.max() + 1


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
    std[:4], std[4 : 4 + NUM_RELIEF] = (80.0, 1e-9, 1e-9, 1e-3), 1e-9
    std[layout.first_lens : layout.first_pose] = np.tile([10.0, 5.0, 5.0, 0.1, 0.1, 0.1, 0.01, 0.01], 2)
    std[layout.first_pose :] = np.tile([0.3, 0.3, 0.3, np.inf, np.inf, np.inf], len(block.cameras))
    assert layout.first_pose + NUM_POSE * len(block.cameras) == len(layout)
    kind, std_px = np.zeros(len(ties.view), dtype=np.int64), np.array([PIXEL_STD])
    priors = Priors(state, std, np.full(ties.start.shape, np.inf))
    problem = Problem(layout, ties, kind, priors, std_px, apparent_rise_design(state, ties))
    system = huber_system(problem, state, std_px)
    weights = np.full(len(kind), PIXEL_STD**-2.0)
    return problem, Solution(state, system.normal.inverse, problem.residuals(state), weights, std_px, system)


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
