"""Laws of the optics that must hold for every survey that can be thought of, on generated ones."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from refract import FlatWater, bend, crossing_point

EPS = np.finfo(np.float64).eps
angles = st.floats(0.0, math.radians(89.9))
turns = st.floats(0.0, 2.0 * math.pi)
indices = st.floats(1.0, 1.6)
heights = st.floats(-3.0, 4.0).map(lambda power: 10.0**power)
depths = st.one_of(st.just(0.0), st.floats(-9.0, 3.0).map(lambda power: 10.0**power))
# Below 1e-300 a unit in the last place is no longer 2.2e-16 of a number.
ways = st.one_of(st.just(0.0), st.floats(1e-300, 500.0))
slopes = st.floats(-1.0, 1.0)
normals = st.tuples(slopes, slopes).map(
    lambda s: np.array(FlatWater((0, 0, 0), n_water=1.0, slope_x=s[0], slope_y=s[1]).up)
)


def leaning(normal, angle, turn):
    """Unit ray that falls toward the plane of `normal` at `angle` [rad] to it."""
    helper = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.7 else np.array([0.0, 1.0, 0.0])
    along = np.cross(normal, helper)
    along /= np.linalg.norm(along)
    across = np.cross(normal, along)
    return math.sin(angle) * (math.cos(turn) * along + math.sin(turn) * across) - math.cos(angle) * normal


@given(angles, turns, normals, indices)
def test_bend_keeps_length_plane_and_side_and_scales_the_sine(angle, turn, normal, n_water):
    ray = leaning(normal, angle, turn)
    bent = bend(ray, normal, n_from=1.0, n_to=n_water)
    assert abs(np.linalg.norm(bent) - 1.0) < 16 * EPS
    assert bent @ normal < 0.0
    np.testing.assert_allclose(np.cross(ray, normal), n_water * np.cross(bent, normal), atol=16 * EPS)


@given(angles, turns, normals, indices)
def test_every_way_through_the_surface_leads_back(angle, turn, normal, n_water):
    ray = leaning(normal, angle, turn)
    back = bend(-bend(ray, normal, n_from=1.0, n_to=n_water), -normal, n_from=n_water, n_to=1.0)
    assert np.linalg.norm(back + ray) < 32 * EPS / math.cos(angle)


@given(ways, heights, depths, indices)
def test_the_crossing_lies_between_straight_line_and_foot_of_the_point(way, height, depth, n_water):
    water, centre = FlatWater((0.0, 0.0, 0.0), n_water=n_water), np.array([0.0, 0.0, height])
    x = crossing_point(np.array([way, 0.0, -depth]), centre, water)[0]
    straight = way * height / (height + depth)
    assert straight - 4 * EPS * way <= x <= way * (1.0 + 4 * EPS)
