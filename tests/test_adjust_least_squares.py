"""The adjustment of the water: truth within its covariance, derivatives, dry points, wrong measurements."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.stats import chi2

from refract import FlatWater, PinholeCamera
from survey.adjust.free_errors import Errors, free_errors
from survey.adjust.least_squares import adjust, intersect
from survey.adjust.projection import by_parameters, by_point, pixels_of
from survey.errors import SurveyError
from survey.photos.tie_points import TiePoints
from tests.small_water_block import TRUTH, convergent, nadir, tie_points, water_of

START = TRUTH + np.array([0.5, -0.002, 0.001, -0.035])
PRIOR = np.array([5.0, 0.05, 0.05, 0.1])
ERRORS = Errors(0.01, np.radians(0.003), 1e-3, 1e-4, 0.1)


def solve(ties, cameras):
    return adjust(cameras, ties, water_of, START, PRIOR)


def test_exact_measurements_give_the_water_back(rng):
    cameras = convergent()
    solved = solve(tie_points(cameras, rng, std_px=0.0), cameras)
    # Noise is floored at 1e-9 px; the start is forgotten but for the prior's pull, (1e-9 px)^2 of it.
    np.testing.assert_allclose(solved.parameters, TRUTH, atol=1e-7)


def test_pixels_are_those_of_the_cameras(rng):
    cameras = convergent()
    ties = tie_points(cameras, rng, count=20)
    for water in (water_of(TRUTH), None):
        pixels = pixels_of(cameras, ties, ties.start, water)
        for n in range(len(ties.view)):
            expected = cameras[ties.view[n]].project(ties.start[ties.point[n]], water)
            # Six Newton steps against sixteen: both are at the rounding of pixels of 1e3.
            np.testing.assert_allclose(pixels[n], expected, atol=1e-10)


def test_derivatives_agree_with_smaller_steps_of_higher_order(rng):
    cameras = convergent()
    ties = tie_points(cameras, rng, count=20)
    h = 1e-3

    def richardson(f):
        return (8.0 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12.0 * h)

    jx, jp = (
        by_point(cameras, ties, ties.start, water_of(TRUTH)),
        by_parameters(cameras, ties, ties.start, water_of, TRUTH),
    )
    for k, axis in enumerate(np.eye(3)):
        slow = richardson(lambda t, a=axis: pixels_of(cameras, ties, ties.start + t * a, water_of(TRUTH)))
        # Derivatives are near 44 px/m; rounding of pixels, 2e-13 over 2e-4, leaves 1e-9, curvature 1e-9.
        np.testing.assert_allclose(jx[..., k], slow, atol=1e-6)
    for k, axis in enumerate(np.eye(4)):
        slow = richardson(lambda t, a=axis: pixels_of(cameras, ties, ties.start, water_of(TRUTH + t * a)))
        np.testing.assert_allclose(jp[..., k], slow, atol=1e-5)


def test_it_agrees_with_a_dense_least_squares_of_all_unknowns(rng):
    """Schur complement against scipy's solver on parameters and points together, without robust weights."""
    cameras = convergent()
    ties = tie_points(cameras, rng, count=12, std_px=1e-4)
    solved = solve(ties, cameras)
    weights = np.sqrt(solved.weights)[:, None]

    def residuals(unknowns):
        water, points = water_of(START + PRIOR * unknowns[:4]), unknowns[4:].reshape(-1, 3)
        pixels = pixels_of(cameras, ties, points, water)
        return np.concatenate([(weights * (ties.pixel - pixels)).ravel(), unknowns[:4]])

    start = np.concatenate([(solved.parameters - START) / PRIOR + 1e-4, solved.points.ravel()])
    slow = least_squares(residuals, start, method="trf", xtol=1e-15, ftol=1e-15, gtol=1e-15)
    std = np.sqrt(np.diag(solved.inverse_normal))
    # The search stops at a thousandth of a standard deviation; the last step is then some millionths.
    assert np.abs(START + PRIOR * slow.x[:4] - solved.parameters).max() < 0.01 * std.max()
    assert (np.abs(START + PRIOR * slow.x[:4] - solved.parameters) < 0.01 * std).all()


def test_errors_are_as_large_as_the_covariance_says():
    cameras = convergent()
    squares = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        solved = solve(tie_points(cameras, rng, count=120), cameras)
        error = solved.parameters - TRUTH
        squares.append(error @ np.linalg.solve(solved.covariance, error))
    # Sum of 30 squares with 4 degrees of freedom each; clusters of 120 points make them a little larger.
    low, high = chi2.ppf([0.001, 0.999], 4 * len(squares))
    assert low < sum(squares) < 1.1 * high


def test_errors_of_poses_are_covered_when_they_are_freed():
    """Poses are drawn from what is assumed of them; the truth lies within the covariance."""
    cameras = convergent()
    squares, held = [], []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        ties = tie_points(cameras, rng, count=120)
        wrong = [spoilt(camera, rng) for camera in cameras]
        solved = adjust(wrong, ties, water_of, START, PRIOR)
        freed = free_errors(wrong, ties, solved, water_of, START, PRIOR, ERRORS)
        error = freed.parameters - TRUTH
        squares.append(error @ np.linalg.solve(freed.covariance, error))
        held.append((solved.parameters - TRUTH) / np.sqrt(np.diag(freed.covariance)))
    low, high = chi2.ppf([0.001, 0.999], 4 * len(squares))
    assert low < sum(squares) < 1.1 * high
    # Held, the same blocks are several times as wrong: the test could fail.
    assert np.sqrt(np.mean(np.square(held))) > 1.5


def spoilt(camera: PinholeCamera, rng) -> PinholeCamera:
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_rotvec(ERRORS.direction_rad * rng.normal(size=3)).as_matrix()
    shift = ERRORS.position_m * rng.normal(size=3)
    return PinholeCamera(
        camera.centre + shift, turn @ camera.cam_from_local, camera.fx, camera.fy, camera.cx, camera.cy,
        camera.width, camera.height,
    )  # fmt: skip


def test_a_block_from_above_is_far_less_certain_than_a_convergent_one(rng):
    stds = []
    for cameras in (nadir(), convergent()):
        ties = tie_points(cameras, rng)
        solved = solve(ties, cameras)
        stds.append(np.sqrt(np.diag(free_errors(cameras, ties, solved, water_of, START, PRIOR, ERRORS).covariance)))
    assert stds[0][0] > 0.1
    assert stds[0][0] > 5.0 * stds[1][0]


def test_wrong_measurements_hardly_move_it():
    cameras = convergent()
    clean = solve(tie_points(cameras, np.random.default_rng(3)), cameras)
    wrong = solve(tie_points(cameras, np.random.default_rng(3), wrong=0.05), cameras)
    std = np.sqrt(np.diag(clean.covariance))
    # One in twenty is up to 200 standard deviations off; Huber's bound lets each pull like two.
    assert (np.abs(wrong.parameters - TRUTH) < 6.0 * std).all()


def test_dry_points_neither_inform_nor_bias(rng):
    cameras = convergent()
    wet, dry = tie_points(cameras, rng), tie_points(cameras, rng, low=0.5, high=3.0)
    both = TiePoints(
        np.concatenate([wet.start, dry.start]),
        np.concatenate([wet.point, dry.point + len(wet)]),
        np.concatenate([wet.view, dry.view]),
        np.concatenate([wet.pixel, dry.pixel]),
    )
    alone, beside = solve(wet, cameras), solve(both, cameras)
    std = np.sqrt(np.diag(alone.covariance))
    # Only the common scale of the residuals differs, which moves the Huber weights a little.
    assert (np.abs(alone.parameters - beside.parameters) < 0.3 * std).all()
    only_dry = adjust(cameras, dry, water_of, TRUTH, PRIOR)
    np.testing.assert_allclose(np.sqrt(np.diag(only_dry.covariance)), PRIOR, rtol=0.05)


def test_points_meet_where_they_were(rng):
    cameras = convergent()
    ties = tie_points(cameras, rng, std_px=0.0)
    points, residuals = intersect(cameras, ties, water_of(TRUTH))
    assert np.abs(residuals).max() < 1e-6
    assert (FlatWater(point=(0, 0, TRUTH[0])).depth(points) > 0.0).all()


def test_too_few_measurements_are_refused(rng):
    cameras = convergent()
    few = tie_points(cameras, rng, count=1)
    with pytest.raises(SurveyError, match="too few"):
        solve(few.only(few.view < 3), cameras)
