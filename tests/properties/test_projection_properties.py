"""Laws of `trace` and `project` together, on any plane of water that can be thought of."""

import math

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from refract import FlatWater, bend, project, trace

always = settings(max_examples=60)
EPS = np.finfo(np.float64).eps
indices = st.one_of(st.just(1.0), st.floats(1.0, 1.6))
heights = st.floats(-2.0, 3.0).map(lambda power: 10.0**power)
depths = st.floats(-3.0, 2.0).map(lambda power: 10.0**power)
angles, turns = st.floats(0.0, math.radians(85.0)), st.floats(0.0, 2.0 * math.pi)
slopes = st.floats(-0.5, 0.5)


@st.composite
def scenes(draw):
    """Water, a camera above it, and the point below it where a ray of the camera ends up."""
    water = FlatWater(
        (draw(st.floats(-9, 9)), draw(st.floats(-9, 9)), draw(st.floats(-9, 9))),
        n_water=draw(indices), slope_x=draw(slopes), slope_y=draw(slopes),
    )  # fmt: skip
    up, height, depth = np.array(water.up), draw(heights), draw(depths)
    camera = np.array(water.point) + height * up
    along = np.cross(up, [0.0, 1.0, 0.0])
    along /= np.linalg.norm(along)
    angle, turn = draw(angles), draw(turns)
    across = np.cross(up, along)
    ray = math.sin(angle) * (math.cos(turn) * along + math.sin(turn) * across) - math.cos(angle) * up
    return water, camera, trace(camera, ray, water).at_height(-depth, water), ray


def rounding(water, camera, point):
    """Angle [rad] of view that rounding of the coordinates stands for: a few units over the shortest length."""
    largest = max(np.abs([*camera, *point, *water.point]).max(), 1.0)
    return 64 * EPS * largest / float(min(-water.depth(camera), 1.0))


@always
@given(scenes())
def test_the_point_appears_where_the_ray_came_from(scene):
    water, camera, point, ray = scene
    assert np.linalg.norm(project(point, camera, water).direction - ray) < rounding(water, camera, point)


@always
@given(scenes())
def test_light_takes_the_same_way_up(scene):
    """Reciprocity: from the point to the crossing, bent out of the water, it arrives at the camera."""
    water, camera, point, _ = scene
    seen = project(point, camera, water)
    leg = seen.crossing - point
    out = bend(leg / seen.water_length, -np.array(water.up), n_from=water.n_water, n_to=1.0)
    # Out of the water the cosine is the root of a difference: rounding grows as one over it, at 85 deg 11 times;
    # and the leg in water is a difference of coordinates.
    allowed = 12 * rounding(water, camera, point) * max(1.0, 1.0 / float(seen.water_length))
    assert np.linalg.norm(out + seen.direction) < allowed


@always
@given(scenes())
def test_no_other_way_is_shorter(scene):
    """Fermat: the optical length of the path is the least of all ways through the surface."""
    water, camera, point, _ = scene
    seen = project(point, camera, water)
    least = seen.air_length + water.n_water * seen.water_length
    up = np.array(water.up)
    size = min(float(-water.depth(camera)), float(water.depth(point)))
    for turn in np.linspace(0.0, 2.0 * math.pi, 7):
        step = np.array([math.cos(turn), math.sin(turn), 0.0])
        step -= (step @ up) * up
        for length in (1e-3 * size, size, 100.0 * size):
            other = seen.crossing + length * step
            way = np.linalg.norm(other - camera) + water.n_water * np.linalg.norm(point - other)
            # Lengths are sums of coordinates that were rounded.
            assert way >= least - 64 * EPS * max(least, np.abs([*camera, *point]).max())


@always
@given(scenes())
def test_tilting_everything_tilts_the_view(scene):
    """In the frame of the plane the water is level."""
    water, camera, point, _ = scene
    to_level = Rotation.align_vectors([[0.0, 0.0, 1.0]], [water.up])[0].as_matrix()
    level = FlatWater((0.0, 0.0, 0.0), n_water=water.n_water)
    origin = np.array(water.point)
    found = project(to_level @ (point - origin), to_level @ (camera - origin), level).direction
    expected = to_level @ project(point, camera, water).direction
    allowed = 4 * rounding(water, camera, point) * max(1.0, 1.0 / float(water.depth(point)))
    assert np.linalg.norm(found - expected) < allowed


@always
@given(scenes(), st.integers(-20, 20))
def test_scaling_everything_leaves_the_view_to_the_last_bit(scene, power):
    water, camera, point, _ = scene
    scale = 2.0**power
    scaled = FlatWater(
        tuple(scale * v for v in water.point), n_water=water.n_water, slope_x=water.slope_x, slope_y=water.slope_y
    )
    plain, larger = project(point, camera, water), project(scale * point, scale * camera, scaled)
    np.testing.assert_array_equal(larger.direction, plain.direction)
    np.testing.assert_array_equal(larger.air_length, scale * plain.air_length)


@always
@given(scenes())
def test_the_parts_of_a_projection_fit_together(scene):
    water, camera, point, _ = scene
    seen = project(point, camera, water)
    largest = max(np.abs([*camera, *point]).max(), 1.0)
    np.testing.assert_allclose(camera + seen.air_length * seen.direction, seen.crossing, atol=16 * EPS * largest)
    assert abs(water.depth(seen.crossing)) < 16 * EPS * largest
    assert abs(np.linalg.norm(point - seen.crossing) - seen.water_length) < 16 * EPS * largest
    assert seen.wet
