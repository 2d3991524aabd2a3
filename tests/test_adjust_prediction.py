"""Lines of sight, Brown's lens and predicted pixels: against refract, OpenCV and finite differences."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from refract import FlatWater
from survey.adjust.block.prediction import Crossing, apparent_rise_design, lines_of_sight, predict
from survey.adjust.block.state import NUM_RELIEF, NUM_WATER, Layout, State, distort, with_parameters
from survey.photos.poses import TiePoints
from tests.block_survey import require_derivatives, state_of
from tests.drawn_block import draw_block

LEVEL = FlatWater((1.0, -2.0, 0.3), n_water=1.34)
TILTED = FlatWater((1.0, -2.0, 0.3), n_water=1.335, slope_x=0.02, slope_y=-0.01)
STEP = 1e-5
# Central differences over STEP: errors of their third derivatives and of rounding over the step, with a wide margin.
CLOSE = 1e-6


def rays(rng, water: FlatWater) -> tuple[np.ndarray, np.ndarray]:
    """Centres and points: wet, dry, just under the surface, and straight below the camera."""
    centres = np.column_stack([rng.uniform(-20.0, 20.0, (60, 2)), rng.uniform(8.0, 40.0, 60)])
    points = np.column_stack([rng.uniform(-10.0, 10.0, (60, 2)), rng.uniform(-8.0, -0.5, 60)])
    points[10:20, 2] = rng.uniform(1.0, 3.0, 10)
    points[20:30, 2] = water.height(*points[20:30, :2].T) - 0.001
    normal = np.array([-water.slope_x, -water.slope_y, 1.0])
    points[30:40] = centres[30:40] - normal * ((centres[30:40, 2] + 6.0) / normal[2])[:, None]
    return centres, points


def crossing_of(centres: np.ndarray, points: np.ndarray, water: FlatWater) -> Crossing:
    return Crossing.of(lines_of_sight(centres, points, water).T, centres.T, points.T, water)


@pytest.mark.parametrize("water", [LEVEL, TILTED], ids=["level", "tilted"])
def test_derivatives_of_bent_lines_of_sight_are_those_of_differences(rng, water):
    centres, points = rays(rng, water)
    wet = water.depth(points) > 0.0
    assert wet.sum() == 50
    centres, points = centres[wet], points[wet]
    crossing = crossing_of(centres, points, water)
    for axis in range(3):
        step = STEP * np.eye(3)[axis]
        by_point = lines_of_sight(centres, points + step, water) - lines_of_sight(centres, points - step, water)
        by_centre = lines_of_sight(centres + step, points, water) - lines_of_sight(centres - step, points, water)
        np.testing.assert_allclose(crossing.by_point()[:, axis].T, by_point / (2.0 * STEP), atol=CLOSE)
        np.testing.assert_allclose(crossing.by_centre()[:, axis].T, by_centre / (2.0 * STEP), atol=CLOSE)
    values = np.array([water.point[2], water.slope_x, water.slope_y, water.n_water])
    by_water = crossing.by_water(water)
    for number in range(NUM_WATER):
        # Under a plane that moves as a whole, points 1 mm below it would come out of the water at a larger step.
        step = STEP * np.eye(NUM_WATER)[number]
        ahead, behind = (lines_of_sight(centres, points, with_parameters(water, values + s)) for s in (step, -step))
        np.testing.assert_allclose(by_water[:, number].T, (ahead - behind) / (2.0 * STEP), atol=20.0 * CLOSE)


def test_straight_below_the_camera_rays_are_straight_and_their_derivatives_finite():
    centre, point = np.array([[1.0, 2.0, 20.0]]), np.array([[1.0, 2.0, -3.0]])
    np.testing.assert_allclose(lines_of_sight(centre, point, LEVEL)[0, :2], 0.0, atol=1e-12)
    crossing = crossing_of(centre, point, LEVEL)
    by_point = crossing.by_point()
    assert all(np.isfinite(values).all() for values in (by_point, crossing.by_centre(), crossing.by_water(LEVEL)))
    # From H = 19.7 m over the water, the crossing of a point h = 3.3 m deep moves by H / (H + h / n) of its step.
    assert by_point[0, 0, 0] == pytest.approx(19.7 / (19.7 + 3.3 / 1.34), rel=1e-9)


def test_a_point_at_the_surface_is_seen_on_a_straight_ray():
    centre, point = np.array([[5.0, 0.0, 20.0]]), np.array([[-4.0, 1.0, 0.3]])
    np.testing.assert_allclose(lines_of_sight(centre, point, LEVEL), point - centre, atol=1e-9)


def test_brown_is_that_of_opencv_with_the_derivatives_of_differences(rng):
    xy = rng.uniform(-0.6, 0.6, (50, 2))
    k1, k2, k3, p1, p2 = coefficients = np.array([0.08, -0.05, 0.02, 0.001, -0.002])
    every = np.tile(coefficients[:, None], 50)
    found, by_xy, by_coefficients = distort(xy.T, every)
    along = np.column_stack([xy, np.ones(50)])
    expected = cv2.projectPoints(along, np.zeros(3), np.zeros(3), np.eye(3), np.array([k1, k2, p1, p2, k3]))[0][:, 0]
    np.testing.assert_allclose(found.T, expected, atol=1e-12)
    for axis in range(2):
        step = STEP * np.eye(2)[axis, :, None]
        difference = distort(xy.T + step, every)[0] - distort(xy.T - step, every)[0]
        np.testing.assert_allclose(by_xy[:, axis], difference / (2.0 * STEP), atol=1e-8)
    for number in range(5):
        step = STEP * np.eye(5)[number, :, None]
        difference = distort(xy.T, every + step)[0] - distort(xy.T, every - step)[0]
        np.testing.assert_allclose(by_coefficients[:, number], difference / (2.0 * STEP), atol=1e-8)


def drawn_state(seed: int) -> tuple[Layout, State, TiePoints]:
    """The truth of a small block."""
    return state_of(draw_block(seed, num_points=30, num_views=8, dry_share=0.3, pixel_std=0.1))


def test_at_the_truth_predictions_miss_by_the_noise_alone():
    layout, state, ties = drawn_state(2)
    miss = ties.pixel - predict(layout, state, ties, np.zeros((len(ties.view), NUM_RELIEF)))
    assert np.std(miss) == pytest.approx(0.1, rel=0.2)
    assert np.abs(miss).max() < 0.6


def test_derivatives_of_predictions_are_those_of_differences():
    layout, state, ties = drawn_state(2)
    linear, rise_design = require_derivatives(layout, state, ties), apparent_rise_design(state, ties)
    for axis in range(3):
        step = STEP * np.eye(3)[[axis] * len(ties)]
        ahead, behind = (
            predict(layout, state.moved(layout, np.zeros(len(layout)), sign * step), ties, rise_design)
            for sign in (1.0, -1.0)
        )
        np.testing.assert_allclose(linear.by_point[:, :, axis], (ahead - behind) / (2.0 * STEP), rtol=1e-5, atol=1e-3)


def test_each_photograph_is_predicted_at_its_own_level(rng):
    layout, state, ties = drawn_state(2)
    tides = rng.uniform(-0.3, 0.3, len(state.centres))
    moving, rise_design = replace(layout, tides=tides), apparent_rise_design(state, ties)
    require_derivatives(moving, state, ties)
    found, still = predict(moving, state, ties, rise_design), predict(layout, state, ties, rise_design)
    assert np.abs(found - still).max() > 0.5
    x, y, z = state.water.point
    for view, tide in enumerate(tides):
        mine = ties.view == view
        own = replace(state, water=replace(state.water, point=(x, y, z + tide)))
        np.testing.assert_allclose(found[mine], predict(layout, own, ties, rise_design)[mine], rtol=0.0, atol=1e-8)


def test_a_rate_of_the_level_raises_the_water_of_each_photograph_by_its_time(rng):
    layout, state, ties = drawn_state(2)
    hours, rise_design = rng.uniform(-0.5, 0.5, len(state.centres)), apparent_rise_design(state, ties)
    moving = replace(layout, hours=hours, tides=rng.uniform(-0.1, 0.1, len(hours)))
    assert len(moving) == len(layout) + 1
    risen = replace(state, rate=0.4)
    require_derivatives(moving, risen, ties)
    by_tides = replace(layout, tides=moving.tides + 0.4 * hours)
    np.testing.assert_allclose(
        predict(moving, risen, ties, rise_design), predict(by_tides, state, ties, rise_design), atol=1e-9
    )


def test_water_over_its_plane_is_water_of_a_higher_level():
    layout, state, ties = drawn_state(2)
    rise_design, (x, y, z) = apparent_rise_design(state, ties), state.water.point
    asked = []

    def departure(xy):
        asked.append(xy)
        return np.full(len(xy), 0.12)

    risen = replace(state, water=replace(state.water, point=(x, y, z + 0.12)))
    found = predict(replace(layout, departure=departure), state, ties, rise_design)
    np.testing.assert_allclose(found, predict(layout, risen, ties, rise_design), rtol=0.0, atol=1e-8)
    # It is asked where rays cross the water: a tenth of the depth from there at most, at 40 degrees.
    points, centres = state.points[ties.point], state.centres[ties.view]
    crossing = centres + lines_of_sight(centres, points, state.water)
    deep = state.water.depth(points)
    wet = deep > 0.0
    assert (np.linalg.norm(asked[0] - crossing[:, :2], axis=1)[wet] < 0.1 * deep[wet]).all()
    np.testing.assert_allclose(asked[0][~wet], points[~wet, :2])


def test_derivatives_hold_where_the_water_is_no_plane():
    layout, state, ties = drawn_state(2)
    # Even slopes: what a step of a point changes of the departure is not in the derivatives.
    require_derivatives(replace(layout, departure=lambda xy: np.full(len(xy), -0.07)), state, ties)


def test_a_point_behind_its_camera_has_no_pixel():
    layout, state, ties = drawn_state(2)
    points = state.points.copy()
    points[ties.point[0], 2] = 500.0
    moved = State(state.water, state.relief, state.lenses, state.centres, state.rotations, points)
    found = predict(layout, moved, ties, np.zeros((len(ties.view), NUM_RELIEF)))
    assert np.isnan(found[ties.point == ties.point[0]]).all()
    assert np.isfinite(found[ties.point != ties.point[0]]).all()
