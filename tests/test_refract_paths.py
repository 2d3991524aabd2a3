"""Bent paths: legs, crossing and heights, and what becomes of every ray, in all libraries."""

import math

import numpy as np
import pytest
import torch
from surface_rays import LIBRARIES, array_of, as_double, llvm

from refract import FlatWater, PinholeCamera, bend, crossing_point, project, trace

EPS = np.finfo(np.float64).eps
LENGTH_M = 1e-12  # coordinates of up to 100 m: 70 units in the last place
LEVEL = FlatWater((0.0, 0.0, 2.0), n_water=1.333)
TILTED = FlatWater((10.0, -4.0, 2.0), n_water=1.34, slope_x=0.05, slope_y=-0.12)
CENTRE = np.array([1.0, 2.0, 37.0])
UP = np.array([0.0, 0.0, 1.0])


def falling_rays(rng, count=500, steepest=80.0):
    incidence, azimuth = np.radians(rng.uniform(0, steepest, count)), rng.uniform(0, 2 * np.pi, count)
    sine = np.sin(incidence)
    return np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -np.cos(incidence)], axis=-1)


def above_plane(points, water):
    return -water.depth(points)


@pytest.mark.parametrize("water", [LEVEL, TILTED])
def test_crossing_lies_on_the_surface_and_on_the_air_leg(rng, water):
    path = trace(CENTRE, falling_rays(rng), water)
    assert path.wet.all()
    assert np.abs(water.depth(path.crossing)).max() < LENGTH_M
    # an incidence of up to 87 deg to the tilted plane: crossings 600 m away
    reached = path.origin + path.air_length[:, None] * path.air_direction
    np.testing.assert_allclose(path.crossing, reached, atol=LENGTH_M)
    height = water.height(path.crossing[:, 0], path.crossing[:, 1])
    np.testing.assert_allclose(path.crossing[:, 2], height, atol=LENGTH_M)


@pytest.mark.parametrize("water", [LEVEL, TILTED, None])
def test_heights_are_measured_along_the_normal_of_the_plane(rng, water):
    path = trace(CENTRE, falling_rays(rng, steepest=60.0), water)
    for height in (30.0, 0.5, 0.0, -0.5, -14.0):
        points = path.at_height(height, water)
        found = above_plane(points, water) if water is not None else points[:, 2]
        np.testing.assert_allclose(found, height, atol=LENGTH_M)


def test_heights_may_differ_per_ray_and_rays_per_height(rng):
    path = trace(CENTRE, falling_rays(rng, count=4), LEVEL)
    heights = np.array([[3.0], [-3.0]])
    points = path.at_height(heights, LEVEL)
    assert points.shape == (2, 4, 3)
    np.testing.assert_array_equal(points[1], path.at_height(-3.0, LEVEL))
    single = trace(CENTRE, falling_rays(rng, count=1)[0], LEVEL)
    assert single.at_height(np.linspace(-5, 5, 11), LEVEL).shape == (11, 3)


def test_path_length_runs_through_both_legs(rng):
    path = trace(CENTRE, falling_rays(rng, steepest=60.0), LEVEL)
    t = rng.uniform(0.0, 90.0, 500)
    points = path.at(t)
    first = np.minimum(t, path.air_length)
    np.testing.assert_allclose(
        points,
        CENTRE + first[:, None] * path.air_direction + (t - first)[:, None] * path.water_direction,
        atol=LENGTH_M,
    )
    np.testing.assert_array_equal(points[:, 2] < 2.0, t > path.air_length)
    step = np.linalg.norm(path.at(t + 0.25) - points, axis=-1)
    assert step.max() < 0.25 + LENGTH_M  # a chord across the bend is shorter
    whole = (t + 0.25 < path.air_length) | (t > path.air_length)
    np.testing.assert_allclose(step[whole], 0.25, atol=LENGTH_M)


@pytest.mark.parametrize("ray", [[0.0, 0.0, 1.0], [0.6, 0.0, 0.8], [1.0, 0.0, 0.0], [1.0, 0.0, -1e-14]])
def test_rays_that_never_meet_the_water_stay_straight_and_dry(ray):
    path = trace(CENTRE, np.array(ray), FlatWater((0.0, 0.0, 2.0), n_water=1.333))
    assert not path.wet
    assert path.air_length == np.inf
    assert np.isnan(path.crossing).all()
    np.testing.assert_array_equal(path.water_direction, ray)
    np.testing.assert_array_equal(path.at(50.0), CENTRE + 50.0 * np.array(ray))
    assert np.isnan(path.at_height(-1.0, LEVEL)).all()


def test_a_ray_that_looks_up_reaches_the_heights_above_it():
    path = trace(CENTRE, np.array([0.6, 0.0, 0.8]), LEVEL)
    np.testing.assert_allclose(path.at_height(39.0, LEVEL), [4.0, 2.0, 41.0], atol=LENGTH_M)


def test_heights_behind_the_camera_are_nan(rng):
    path = trace(CENTRE, falling_rays(rng), LEVEL)
    assert np.isnan(path.at_height(35.001, LEVEL)).all()
    np.testing.assert_array_equal(path.at_height(35.0, LEVEL), np.broadcast_to(CENTRE, (500, 3)))


def test_grazing_rays_cross_far_away_and_stay_finite():
    delta = np.array([1e-3, 1e-6, 1e-9])
    ray = np.stack([np.cos(delta), np.zeros(3), -np.sin(delta)], axis=-1)
    path = trace(CENTRE, ray, LEVEL)
    assert path.wet.all()
    np.testing.assert_allclose(path.air_length, 35.0 / np.sin(delta), rtol=1e-12)
    critical = math.asin(1.0 / 1.333)
    np.testing.assert_allclose(path.water_direction[1:, 0], math.sin(critical), rtol=1e-11)


@pytest.mark.parametrize("z", [2.0, 1.5, -8.0])
def test_a_camera_under_water_has_one_straight_wet_leg(rng, z):
    centre = np.array([1.0, 2.0, z])
    rays = falling_rays(rng)
    path = trace(centre, rays, LEVEL)
    assert path.wet.all()
    np.testing.assert_array_equal(path.crossing, np.broadcast_to(centre, (500, 3)))
    np.testing.assert_array_equal(path.air_length, 0.0)
    np.testing.assert_array_equal(path.water_direction, rays)
    np.testing.assert_allclose(path.at(3.0), centre + 3.0 * rays, atol=LENGTH_M)
    points = path.at_height(-12.0, LEVEL)
    np.testing.assert_allclose(points[:, 2], -10.0, atol=LENGTH_M)
    assert np.linalg.norm(np.cross(points - centre, rays), axis=-1).max() < 10 * LENGTH_M


def test_origins_and_directions_broadcast(rng):
    centres = rng.normal(size=(5, 1, 3)) + CENTRE
    path = trace(centres, falling_rays(rng, count=7), LEVEL)
    assert path.crossing.shape == (5, 7, 3)
    assert path.air_length.shape == (5, 7)
    empty = trace(CENTRE, np.zeros((0, 3)), LEVEL)
    assert empty.at_height(-1.0, LEVEL).shape == (0, 3)


DOWN = np.tile([0.0, 0.0, -1.0], (4, 1))
CAMERA = PinholeCamera([3.0, -2.0, 30.0], np.diag([1.0, -1.0, -1.0]), 900.0, 910.0, 250.0, 195.0, 512, 384)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: trace(np.zeros(2), np.zeros((4, 3)), LEVEL), r"\(2,\)"),
        (lambda: trace(np.zeros((5, 3)), np.zeros((4, 3)), LEVEL), r"\(5, 3\)"),
        (lambda: trace(CENTRE, DOWN, LEVEL).at_height(np.zeros(3), LEVEL), r"\(3,\)"),
        (lambda: trace(CENTRE, DOWN, LEVEL).at(np.zeros(3)), r"\(3,\)"),
        (lambda: crossing_point(np.zeros((5, 2)), np.zeros(3), LEVEL), r"\(5, 2\)"),
        (lambda: crossing_point(np.zeros((5, 3)), np.zeros((4, 3)), LEVEL), r"points \(5, 3\), camera \(4, 3\)"),
        (lambda: CAMERA.directions(np.zeros(3)), r"\(3,\)"),
        (lambda: CAMERA.project(np.zeros((4, 2)), None), r"\(4, 2\)"),
        (lambda: bend(np.zeros((4, 2)), UP, n_from=1.0, n_to=1.333), r"\(4, 2\)"),
        (lambda: bend(np.zeros((4, 3)), np.zeros((5, 3)), n_from=1.0, n_to=1.333), r"ray \(4, 3\), normal \(5, 3\)"),
        (lambda: bend(np.float64(1.0), UP, n_from=1.0, n_to=1.333), r"\(\)"),
    ],
)
def test_wrong_shapes_are_value_errors_that_name_them(call, words):
    with pytest.raises(ValueError, match=words):
        call()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"point": (0.0, 0.0)}, "three finite coordinates"),
        ({"point": (0.0, 0.0, math.nan)}, "nan"),
        ({"point": (0.0, 0.0, 0.0), "n_water": 0.75}, r"0\.75"),
        ({"point": (0.0, 0.0, 0.0), "n_water": math.inf}, "finite index"),
        ({"point": (0.0, 0.0, 0.0), "slope_x": math.nan}, "finite slopes"),
        ({"point": (0.0, 0.0, 0.0), "n_water": [1.33, 2.5]}, "expected .* index"),
        ({"point": (0.0, 0.0, 0.0), "slope_x": [0.0, np.nan]}, "expected .* index"),
        *(
            ({"point": (0, 0, 0), "n_water": torch.tensor(n, requires_grad=True)}, "index")
            for n in (math.nan, 0.9, 2.5)
        ),
    ],
)
def test_impossible_water_is_refused_with_what_was_expected(arguments, words):
    with pytest.raises(ValueError, match=words):
        FlatWater(**arguments)


def test_slopes_are_the_rise_per_metre_along_each_axis():
    water = FlatWater((10.0, 20.0, 3.0), n_water=1.333, slope_x=0.5, slope_y=-0.25)
    assert water.height(12.0, 24.0) == 3.0 + 1.0 - 1.0
    np.testing.assert_allclose(np.linalg.norm(water.up), 1.0, atol=2 * EPS)
    on_plane = np.array([14.0, 20.0, 5.0])
    assert water.depth(on_plane) == pytest.approx(0.0, abs=8 * EPS)
    # One metre straight down is less than a metre along the normal.
    assert water.depth(on_plane - [0.0, 0.0, 1.0]) == pytest.approx(1.0 / math.sqrt(1.3125), abs=16 * EPS)


def test_rays_must_come_from_the_library_of_the_water():
    water = FlatWater((0.0, 0.0, torch.tensor(2.0, requires_grad=True)))
    for call in (trace, project):
        with pytest.raises(TypeError, match=r"torch.*numpy.*one library"):
            call(CENTRE, np.array([0.0, 0.0, -1.0]), water)
    ray = torch.tensor([0.0, 0.0, -1.0], dtype=torch.float64)
    assert trace(torch.tensor(CENTRE), ray, water).air_length == 35.0
    learnt = FlatWater((0.0, 0.0, 2.0), n_water=torch.nn.Parameter(torch.tensor(1.3, dtype=torch.float64)))
    assert project(torch.tensor([1.0, 2.0, -1.0]).double(), torch.tensor(CENTRE), learnt).direction[2] == -1.0


def test_vectors_of_drjit_are_refused_with_the_way_to_go():
    rays = llvm().Array3f(0.0, 0.0, -1.0)
    for call in (lambda: trace(CENTRE, rays, LEVEL), lambda: project(rays, CENTRE, LEVEL)):
        with pytest.raises(TypeError, match=r"expected arrays of numpy or torch.*refract\.kernels"):
            call()


def test_heights_under_waves_are_refused():
    path = trace(CENTRE, np.array([0.0, 0.0, -1.0]), LEVEL)
    with pytest.raises(TypeError, match=r"expected FlatWater or None.*use at\(t\)"):
        path.at_height(-1.0, "waves")


WATER = FlatWater((0.0, 0.0, 2.0), n_water=1.34)
HIGH_CENTRE = np.array([1.0, -2.0, 30.0])
NAN, INF = math.nan, math.inf

# A row each, whether it is wet, and whether it is valid.
RAYS = [
    ([0.6, 0.0, -0.8], True, True),
    ([0.0, 0.0, -1.0], True, True),
    ([0.6, 0.0, 0.8], False, True),
    ([0.0, 1.0, 0.0], False, True),
    ([NAN, 0.0, -1.0], False, False),
    ([0.0, 0.0, -INF], False, False),
]
POINTS = [
    ([4.0, 1.0, -3.0], True, True),
    ([1.0, -2.0, -3.0], True, True),
    ([4.0, 1.0, 2.0], False, True),
    ([4.0, 1.0, 12.0], False, True),
    ([1.0, -2.0, 30.0], False, False),
    ([4.0, NAN, -3.0], False, False),
    ([4.0, 1.0, -INF], False, False),
]
(DIRECTIONS, WET_RAYS, VALID_RAYS), (PLACES, WET_POINTS, VALID_POINTS) = (
    zip(*rows, strict=True) for rows in (RAYS, POINTS)
)


@pytest.mark.parametrize("library", LIBRARIES)
def test_rays_and_points_are_wet_straight_or_invalid_one_by_one(library):
    path = trace(HIGH_CENTRE, array_of(library, DIRECTIONS), WATER)
    np.testing.assert_array_equal(np.asarray(path.wet), WET_RAYS)
    np.testing.assert_allclose(as_double(path.water_direction)[2:4], DIRECTIONS[2:4], atol=1e-7)
    np.testing.assert_array_equal(np.isnan(as_double(path.crossing)).all(axis=-1), ~np.array(WET_RAYS))
    np.testing.assert_array_equal(np.isfinite(np.asarray(path.air_length)), WET_RAYS)
    np.testing.assert_array_equal(~np.isnan(np.asarray(path.air_length)), VALID_RAYS)
    seen = project(array_of(library, PLACES), HIGH_CENTRE, WATER)
    np.testing.assert_array_equal(~np.isnan(as_double(seen.direction)).any(axis=-1), VALID_POINTS)
    np.testing.assert_array_equal(np.asarray(seen.wet), WET_POINTS)


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_camera_under_water_looks_straight(library):
    low = np.array([0.0, 0.0, -1.0])
    path = trace(low, array_of(library, DIRECTIONS), WATER)
    np.testing.assert_array_equal(np.asarray(path.air_length), np.where(VALID_RAYS, 0.0, NAN))
    seen = project(array_of(library, PLACES), low, WATER)
    way = np.array(PLACES[:4]) - low
    length = np.linalg.norm(way, axis=-1)
    # float32: one rounding of the result
    np.testing.assert_allclose(as_double(seen.direction)[:4], way / length[:, None], atol=1e-7)
    np.testing.assert_allclose(np.asarray(seen.water_length)[:4], length * [1, 1, 0, 0], rtol=1e-7)
    np.testing.assert_allclose(np.asarray(seen.air_length)[:4], length * [0, 0, 1, 1], rtol=1e-7)


@pytest.mark.parametrize("library", LIBRARIES)
def test_without_water_all_rays_are_straight(library):
    path = trace(HIGH_CENTRE, array_of(library, DIRECTIONS), None)
    np.testing.assert_array_equal(np.asarray(path.air_length), np.where(VALID_RAYS, INF, NAN))
    seen = project(array_of(library, PLACES), HIGH_CENTRE, None)
    assert not np.asarray(path.wet).any()
    assert not np.asarray(seen.wet).any()
    np.testing.assert_array_equal(as_double(seen.crossing)[:5], PLACES[:5])


@pytest.mark.parametrize("library", LIBRARIES)
def test_rays_out_of_the_water_that_are_reflected_are_nan(library):
    critical = math.asin(1.0 / 1.34)
    angles = [0.0, 0.5, critical + 1e-4, math.pi / 2, math.pi, NAN]
    up = [[math.sin(a), 0.0, math.cos(a) if a != math.pi / 2 else 0.0] for a in angles]
    bent = as_double(bend(array_of(library, up), np.array([0.0, 0.0, -1.0]), n_from=1.34, n_to=1.0))
    np.testing.assert_array_equal(np.isnan(bent).any(axis=-1), [False, False, True, True, True, True])


def test_a_ray_that_would_pass_behind_the_camera_never_meets_the_water():
    # Not even when the plane is 45 degrees steep and the ray runs along it, up to its rounding.
    water = FlatWater((0.0, 0.0, 0.0), n_water=1.34, slope_x=1.0)
    half = math.sqrt(0.5)
    path = trace(np.array([0.0, 0.0, 5.0]), np.array([[half, 0.0, half], [-half, 0.0, half]]), water)
    assert not path.wet.any()
    assert np.isinf(path.air_length).all()
