"""Curved water: laws of optics on numpy and torch, derivatives, and surfaces of one's own."""

import importlib
import math
from pathlib import Path

import mpmath
import numpy as np
import pytest
import torch
from fifty_digits import exact_derivatives, worst
from hypothesis import given, settings
from hypothesis import strategies as st
from slow_cases import slow
from surface_rays import DOUBLE, LIBRARIES, Bowl, array_of, as_double, bed_points, cameras, falling_rays, view_angle
from torch.func import hessian, jacfwd, jacrev, vmap

from refract import FlatWater, crossing_point, kernels, project, trace
from refract.curved import BicubicWater, CurvedWater, WavyWater

CENTRE = np.array([1.0, -2.0, 40.0])
# Coordinates of 60 m, some twenty roundings.
NEAR_M, NEAR_RAD = 1e-12, 1e-12
# float32: the bed point, some 60 m from the origin, is rounded by 2e-6 m, seen from 10 m and more; and the ray by 1e-7.
NEAR_RAD_32 = 2e-6
always = settings(max_examples=40)


def waves(level=0.3, n_water=1.333):
    return WavyWater((0.0, 0.0, level), (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2)), (0.3, 1.0), n_water=n_water)


NODES = np.arange(-120.0, 121.0, 4.0)
RELIEF = 0.05 * np.sin(0.2 * NODES) * np.cos(0.3 * NODES[:, None])


def pieces(level=0.3, n_water=1.333):
    relief = RELIEF if isinstance(level, float) else torch.tensor(RELIEF, dtype=level.dtype)
    return BicubicWater((-120.0, -120.0), 4.0, relief + level, n_water=n_water)


KINDS = {"waves": waves, "cubic pieces": pieces, "height and gradient": Bowl}
# Waves that focus light from a metre below: several paths lead up from deeper points.
CHOP = WavyWater((0.0, 0.0, 0.0), (0.03, 0.012), ((6.0, 1.0), (-4.0, 13.0)), (0.3, 1.1))


def seen_rays(rng, count, flattest_deg=50.0):
    """Camera centres 10 to 60 m up, and unit rays: (count, 3)."""
    return (
        np.stack(v, axis=-1) for v in (cameras(rng, count, (10.0, 60.0)), falling_rays(rng, count, 0, flattest_deg))
    )


@pytest.mark.parametrize("library", LIBRARIES)
@pytest.mark.parametrize("kind", KINDS)
def test_project_gives_the_traced_ray_back(rng, kind, library):
    camera, ray = (array_of(library, each) for each in seen_rays(rng, 300))
    water = KINDS[kind]()
    path = trace(camera, ray, water)
    back = project(path.at(path.air_length + 3.0), camera, water)
    angle = np.linalg.norm(np.cross(as_double(back.direction), as_double(ray)), axis=-1)
    assert angle.max() < (NEAR_RAD_32 if library == "torch.float32" else NEAR_RAD)
    assert path.wet.all()
    assert back.wet.all()


@pytest.mark.parametrize("kind", KINDS)
@always
@given(seed=st.integers(0, 2**32 - 1), n_water=st.floats(1.0, 1.6), depth=st.floats(-3.0, 1.5))
def test_paths_obey_snell_and_fermat(kind, seed, n_water, depth):
    """The tangential part of the ray times its index is the same on both sides, and no way nearby is shorter."""
    rng, water = np.random.default_rng(seed), KINDS[kind](n_water=n_water)
    camera, ray = seen_rays(rng, 5)
    path = trace(camera, ray, water)
    bed = path.at(path.air_length + 10.0**depth)
    seen = project(bed, camera, water)
    normal = np.stack(water.normal(*seen.crossing[:, :2].T), axis=-1)
    legs = bed - seen.crossing
    assert (
        np.linalg.norm(np.cross(path.water_direction, normal) * n_water - np.cross(ray, normal), axis=1).max() < 1e-14
    )
    # The leg of a point just below the surface is a difference of coordinates of 60 m.
    off = np.cross(legs, normal) * n_water / seen.water_length[:, None] - np.cross(seen.direction, normal)
    assert np.linalg.norm(off, axis=1).max() < 1e-13 + NEAR_M / 10.0**depth
    np.testing.assert_allclose(seen.crossing, path.crossing, atol=NEAR_M * (1.0 + 0.1 / (n_water - 0.99)))
    least = seen.air_length + n_water * seen.water_length
    for turn in np.linspace(0.0, 2.0 * math.pi, 7):
        x, y = seen.crossing[:, 0] + 0.01 * math.cos(turn), seen.crossing[:, 1] + 0.01 * math.sin(turn)
        way = np.stack([x, y, water.height(x, y)], axis=-1)
        assert np.all(
            np.linalg.norm(way - camera, axis=1) + n_water * np.linalg.norm(way - bed, axis=1) > least - 1e-13
        )


@pytest.mark.parametrize("kind", KINDS)
def test_an_index_of_one_and_a_ray_along_the_normal_stay_straight(rng, kind):
    camera, ray = seen_rays(rng, 50)
    np.testing.assert_allclose(trace(camera, ray, KINDS[kind](n_water=1.0)).water_direction, ray, atol=1e-15)
    bed = rng.uniform((-20.0, -20.0, -6.0), (20.0, 20.0, -0.5), (50, 3))
    way = bed - camera
    found = project(bed, camera, KINDS[kind](n_water=1.0)).direction
    np.testing.assert_allclose(found, way / np.linalg.norm(way, axis=1, keepdims=True), atol=1e-14)
    water = KINDS[kind]()
    x, y = rng.uniform(-10.0, 10.0, (2, 50))
    foot, normal = np.stack([x, y, water.height(x, y)], axis=-1), np.stack(water.normal(x, y), axis=-1)
    path = trace(foot + 20.0 * normal, -normal, water)
    np.testing.assert_allclose(path.crossing, foot, atol=NEAR_M)
    np.testing.assert_allclose(path.water_direction, -normal, atol=NEAR_M)


@pytest.mark.parametrize("kind", KINDS)
def test_gradient_and_hessian_are_the_derivatives_of_the_height(rng, kind):
    water, step = KINDS[kind](), 1e-4
    x, y = rng.uniform(-20.0, 20.0, (2, 100))

    def rate(function, dx, dy):
        return (np.array(function(x + dx, y + dy)) - function(x - dx, y - dy)) / (2.0 * step)

    np.testing.assert_allclose(
        water.gradient(x, y), [rate(water.height, step, 0), rate(water.height, 0, step)], atol=1e-8
    )
    xx, xy, yy = water.hessian(x, y)
    np.testing.assert_allclose([xx, xy], rate(water.gradient, step, 0), atol=3e-7)
    np.testing.assert_allclose([xy, yy], rate(water.gradient, 0, step), atol=3e-7)


def test_surfaces_that_are_the_same_plane_are_the_plane(rng):
    flat = FlatWater((1.0, 2.0, 0.5), n_water=1.34, slope_x=0.01, slope_y=-0.02)
    same = (
        WavyWater(flat.point, (0.0,), ((2.0, 0.0),), n_water=1.34, slope_x=0.01, slope_y=-0.02),
        BicubicWater(
            (-150.0, -150.0), 30.0, flat.height(*np.meshgrid(*[np.arange(-150.0, 151.0, 30.0)] * 2)), n_water=1.34
        ),
    )
    camera, ray = seen_rays(rng, 300)
    bed = rng.uniform((-30.0, -30.0, -10.0), (30.0, 30.0, 3.0), (300, 3))
    expected, there = trace(camera, ray, flat), crossing_point(bed, camera, flat)
    for water in same:
        np.testing.assert_allclose(trace(camera, ray, water).crossing, expected.crossing, atol=NEAR_M)
        np.testing.assert_allclose(crossing_point(bed, camera, water), there, atol=NEAR_M)


@pytest.mark.parametrize("flattest_deg", [60.0, 89.9])
def test_no_wave_is_skipped(rng, flattest_deg):
    """Against a walk along the ray in 20 000 steps, a small part of a wave each, from the highest crest down."""
    k = 2.0 * math.pi / np.array([2.0, 1.1, 0.4])
    vectors = np.stack([k * np.cos([0.3, 1.7, -0.4]), k * np.sin([0.3, 1.7, -0.4])], axis=-1)
    rough = WavyWater((1.0, 2.0, 0.5), (0.06, 0.03, 0.01), vectors, (0.3, 1.3, 2.3), slope_y=0.002)
    camera, ray = cameras(rng, 60, (0.7, 3.0)), falling_rays(rng, 60, flattest_deg - 20.0, flattest_deg)
    found = rough.intersect(camera, ray)
    x, y, z = kernels.point_at_distance(camera, ray, found)
    np.testing.assert_allclose(z, rough.height(x, y), atol=NEAR_M)
    crest = 0.5 + 0.1 + 0.002 * 40.0
    start = np.maximum((camera[2] - crest) / -ray[2], 0.0)
    t = start + (found - start) * np.linspace(0.0, 1.0, 20_000, endpoint=False)[:, None]
    x, y, z = kernels.point_at_distance(camera, ray, t)
    assert np.all(z > rough.height(x, y))


def test_rays_that_rise_meet_a_crest_or_nothing():
    """From a trough, level rays end in the next crest, steeper ones pass it, as plain geometry says."""
    swell = WavyWater((0.0, 0.0, 0.0), (1.0,), ((1.0, 0.0),))
    camera = np.full(3, -0.5 * math.pi), np.zeros(3), np.full(3, 0.0)  # 1 m over the trough
    rise = np.array([0.0, 0.2, 0.6])
    found = swell.intersect(camera, (np.cos(rise), np.zeros(3), np.sin(rise)))
    np.testing.assert_allclose(found[0], 0.5 * math.pi, rtol=1e-14)  # z = 0 is met again at x = 0
    np.testing.assert_array_equal(np.isfinite(found), [True, True, False])
    above = swell.intersect((np.zeros(1), np.zeros(1), np.full(1, 1.5)), (np.ones(1), np.zeros(1), np.zeros(1)))
    assert np.isnan(above[0])


def test_every_point_below_focusing_waves_is_seen_along_a_least_path(rng):
    """Where the ray that was traced is not taken, another path is, which is a minimum of the optical length as well."""
    camera, ray = cameras(rng, 300, (5.0, 20.0)), falling_rays(rng, 300, flattest_deg=45.0)
    bed = bed_points(CHOP, camera, ray, rng.uniform(0.2, 5.0, 300))
    found, _ = CHOP.crossing(camera, bed, 4)
    assert np.isfinite(found).all()
    assert 0.2 < (view_angle(camera, found, ray) < NEAR_RAD).mean() < 0.9
    camera, bed, found = (np.stack(v, axis=-1) for v in (camera, bed, found))

    def length(x, y):
        way = np.stack([x, y, CHOP.height(x, y)], axis=-1)
        return np.linalg.norm(way - camera, axis=1) + CHOP.n_water * np.linalg.norm(way - bed, axis=1)

    for turn in np.linspace(0.0, 2.0 * math.pi, 13):
        nearby = length(found[:, 0] + 1e-4 * math.cos(turn), found[:, 1] + 1e-4 * math.sin(turn))
        assert np.all(nearby > length(*found[:, :2].T) - 1e-13)


@pytest.mark.parametrize("kind", KINDS)
def test_what_has_no_answer_is_marked(kind):
    up, down = [0.0, 0.6, 0.8], [0.0, 0.0, -1.0]
    camera = np.array([[0.0, 0.0, 10.0], [0.0, 0.0, 10.0], [0.0, 0.0, -1.0], [np.nan, 0.0, 10.0]])
    path = trace(camera, np.array([up, down, down, down]), KINDS[kind]())
    np.testing.assert_array_equal(path.wet, [False, True, True, False])
    np.testing.assert_array_equal(path.air_length[[0, 2, 3]], [np.inf, 0.0, np.nan])
    np.testing.assert_array_equal(np.isnan(path.crossing[:, 0]), [True, False, False, True])
    points = np.array([[1.0, 1.0, 5.0], [1.0, 1.0, -2.0], [1.0, 1.0, -2.0], [1.0, 1.0, -2.0]])
    back = project(points, camera, KINDS[kind]())
    np.testing.assert_array_equal(back.water_length[[0, 3]], [0.0, np.nan])
    assert back.air_length[2] == 0.0
    np.testing.assert_array_equal(back.crossing[0], points[0])
    assert project(points[1], camera[1], KINDS[kind]()).direction.shape == (3,)


def test_beside_measured_heights_rays_are_straight_and_from_the_side_under_water_too():
    water = pieces()
    beside = np.array([[300.0, 0.0, -3.0], [3.0, 1.0, -3.0]])
    ray = (beside - CENTRE) / np.linalg.norm(beside - CENTRE, axis=-1, keepdims=True)
    np.testing.assert_array_equal(project(beside, CENTRE, water).wet, [False, True])
    np.testing.assert_array_equal(trace(CENTRE, ray, water).wet, [False, True])
    below = trace(np.array([-130.0, 0.0, 0.0]), np.array([0.8, 0.0, -0.6]), water)
    assert not below.wet


def test_cubic_pieces_meet_nodes_and_parabolas_and_have_no_edges(rng):
    def parabola(x, y):
        return 0.2 + 0.01 * x - 0.02 * y + 0.003 * x * x - 0.002 * x * y + 0.001 * y * y

    nodes = np.stack(np.meshgrid(2.0 + 0.5 * np.arange(9), -1.0 + 0.5 * np.arange(7)), axis=-1)
    water = BicubicWater((2.0, -1.0), 0.5, parabola(nodes[..., 0], nodes[..., 1]))
    x, y = rng.uniform(2.0, 6.0, 500), rng.uniform(-1.0, 2.0, 500)
    np.testing.assert_allclose(water.height(x, y), parabola(x, y), atol=1e-14)  # up to the rim
    rough = BicubicWater((2.0, -1.0), 0.5, rng.normal(size=(7, 9)))
    np.testing.assert_allclose(rough.height(nodes[..., 0], nodes[..., 1]), rough.heights, atol=1e-14)
    edges = np.arange(2.5, 6.0, 0.5)
    for here, there in zip(rough.normal(edges - 1e-9, 0.3), rough.normal(edges + 1e-9, 0.3), strict=True):
        np.testing.assert_allclose(here, there, atol=1e-6)
    assert np.isnan(rough.height(np.array([1.99, 6.01, 4.0]), np.array([0.0, 0.0, 2.01]))).all()
    low, high = rough._range
    assert np.all((low < rough.height(x, y)) & (rough.height(x, y) < high))


def test_directions_through_cubic_pieces_converge_with_the_square_of_the_spacing(rng):
    water = WavyWater((0.0, 0.0, 0.0), (0.05, 0.03), ((1.0, 0.5), (-0.4, 0.8)))
    points = rng.uniform([-15, -15, -6], [15, 15, -1], (200, 3))
    exact, errors = project(points, CENTRE, water).direction, []
    for spacing in (1.0, 0.5, 0.25):
        x = np.arange(-24.0, 24.0 + 0.5 * spacing, spacing)
        measured = BicubicWater((-24.0, -24.0), spacing, water.height(*np.meshgrid(x, x)))
        errors.append(np.sqrt(np.mean((project(points, CENTRE, measured).direction - exact) ** 2)))
    assert errors[-1] < 2e-5
    assert abs(np.log2(errors[0] / errors[-1]) / 2.0 - 2.0) < 0.25


def test_scattered_points_give_the_surface_that_they_are_of(rng):
    water = WavyWater((0.0, 0.0, 0.0), (0.05,), ((0.3, 0.1),))
    points = rng.uniform(-30.0, 30.0, (4000, 2))
    measured = BicubicWater.from_points(points, water.height(*points.T))
    x, y = rng.uniform(-25.0, 25.0, (2, 500))
    # Linear over triangles of 1 to 3 m: curvature 5e-3 / m times the square of a side over 8.
    np.testing.assert_allclose(measured.height(x, y), water.height(x, y), atol=6e-3)
    assert np.std(measured.height(x, y) - water.height(x, y)) < 1e-3
    for few in (
        [[0.0, 0.0], [1.0, 1.0]],
        [[0.0, 0.0], [1.0, 1.0], [2.0, 2.0]],
        [[0.0, 0.0], [1.0, np.nan], [2.0, 0.0]],
    ):
        with pytest.raises(ValueError, match="expected three points or more, finite and not on one line"):
            BicubicWater.from_points(few, np.zeros(len(few)))


def test_far_ripples_keep_their_phase_in_float32():
    x, ripple = torch.full((1,), 1000.0), WavyWater((0.0, 0.0, 0.0), (0.01,), ((15.0, 0.0),))
    found = ripple.normal(x, 0.0 * x)
    assert found[0].dtype == torch.float32
    np.testing.assert_allclose(
        [float(c) for c in found],
        np.ravel(ripple.normal(np.array([1000.0]), np.zeros(1))),
        atol=np.finfo(np.float32).eps,
    )


def test_waves_move_with_their_frequency(rng):
    moving = WavyWater((1.0, 2.0, 0.5), (0.1,), ((2.0, 0.0),), frequencies=(3.0,))
    x, y = rng.uniform(-3.0, 3.0, (2, 20))
    np.testing.assert_allclose(moving.at(0.4).height(x + 0.6, y), moving.height(x, y), atol=1e-15)


def moved(water, camera, ray, point):
    """What trace and project say, in one row."""
    path, seen = trace(camera, ray, water), project(point, camera, water)
    return torch.cat([path.crossing, path.water_direction, seen.direction, seen.crossing], dim=-1)


def test_derivatives_by_every_parameter_of_waves_are_those_of_differences():
    def function(plane, amplitudes, vectors, phases, camera, point):
        x, y, z, n, slope = plane
        water = WavyWater((x, y, z), amplitudes, vectors, phases, n_water=n, slope_x=slope)
        ray = (point - camera) / torch.linalg.norm(point - camera)
        return moved(water, camera, ray, point)

    numbers = (
        [1.0, 2.0, 0.5, 1.333, 0.01], [0.05, 0.02], [[1.9, -0.7], [0.3, 2.0]], [0.4, 0.1], [1.0, 2.0, 30.0],
        [9.0, 2.0, -3.0],
    )  # fmt: skip
    leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in numbers]
    assert torch.autograd.gradcheck(function, leaves, eps=1e-6, atol=1e-6)


def test_derivatives_by_the_nodes_are_those_of_differences():
    heights = torch.tensor(RELIEF[:5, :5], requires_grad=True)
    camera, ray, point = (
        torch.tensor(v, dtype=torch.float64) for v in (CENTRE, [0.0, 0.1, -(0.99**0.5)], [2.0, -1.0, -3.0])
    )

    def function(heights):
        return moved(BicubicWater((-8.0, -8.0), 4.0, heights), camera, ray, point)

    assert torch.autograd.gradcheck(function, heights, eps=1e-6, atol=1e-8)


@pytest.mark.parametrize("kind", [slow("waves"), slow("cubic pieces"), "height and gradient"])
def test_transforms_of_torch_agree_with_the_tape_beside_dry_and_missing_points(rng, kind):
    camera, rays = (torch.tensor(v) for v in seen_rays(rng, 3))
    points = torch.tensor([[8.0, 3.0, -3.0], [8.0, 3.0, 5.0], [math.nan, 0.0, 0.0]]).double()

    def told(numbers):
        return torch.nan_to_num(moved(KINDS[kind](numbers[0], numbers[1]), camera + numbers[2], rays, points))

    numbers = torch.tensor([0.1, 1.33, 0.2], dtype=torch.float64)
    taped = torch.autograd.functional.jacobian(told, numbers)
    assert torch.isfinite(taped).all()
    for mode in (jacrev, jacfwd):
        torch.testing.assert_close(mode(told)(numbers), taped, rtol=1e-12, atol=1e-13)
    both = torch.stack([numbers, numbers + 0.01])
    torch.testing.assert_close(vmap(told)(both), torch.stack([told(each) for each in both]), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: WavyWater((0.0, 0.0, 0.0), (0.1, 0.2), ((1.0, 0.0),)), r"\(2, 1, 2, 2\)"),
        (lambda: WavyWater((0.0, 0.0, 0.0), (math.nan,), ((1.0, 0.0),)), "finite"),
        (lambda: WavyWater((0.0, 0.0, 0.0), (0.1,), ((1.0, 0.0),), n_water=2.5), r"2\.5"),
        (lambda: BicubicWater((0.0, 0.0), 1.0, np.zeros((2, 5))), r"\(2, 5\)"),
        (lambda: BicubicWater((0.0, 0.0), 0.0, np.zeros((4, 5))), "positive spacing"),
        (lambda: BicubicWater((0.0, 0.0), 1.0, np.full((4, 5), np.nan)), "expected finite heights, got 20 others"),
        (lambda: BicubicWater((0.0, 0.0), 1.0, np.zeros((4, 5)), n_water=0.9), "index of water"),
    ],
)
def test_wrong_numbers_are_named(make, message):
    with pytest.raises(ValueError, match=message):
        make()


PLUGIN = """
from refract.curved import CurvedWater


class Vortex(CurvedWater):
    def __init__(self, depth, radius, n_water=1.333):
        self.depth, self.radius, self.n_water = depth, radius, n_water

    def height(self, x, y):
        return -self.depth / (1.0 + (x * x + y * y) / self.radius**2)

    def gradient(self, x, y):
        slope = 2.0 * self.depth / self.radius**2 / (1.0 + (x * x + y * y) / self.radius**2) ** 2
        return slope * x, slope * y
"""


@pytest.mark.parametrize("library", DOUBLE)
def test_a_surface_is_a_file_with_height_and_gradient_as_the_recipe_says(rng, tmp_path, monkeypatch, library):
    recipe = (
        (Path(__file__).parent.parent / "CONTRIBUTING.md").read_text(encoding="utf-8").split("**A water surface**")[1]
    )
    recipe = recipe.split("\n\n")[0]
    assert CurvedWater.__abstractmethods__ == {"height", "gradient"}
    for name in (
        "refract.curved.CurvedWater",
        "n_water",
        "height",
        "gradient",
        "KINDS",
        f"tests/{Path(__file__).name}",
    ):
        assert f"`{name}`" in recipe
    (tmp_path / "vortex.py").write_text(PLUGIN, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    water = importlib.import_module("vortex").Vortex(0.05, 2.0)
    camera, ray = (array_of(library, each) for each in seen_rays(rng, 100))
    path = trace(camera, ray, water)
    back = project(path.at(path.air_length + 2.0), camera, water)
    assert np.linalg.norm(np.cross(as_double(back.direction), as_double(ray)), axis=-1).max() < NEAR_RAD
    if library != "numpy":
        depth = torch.tensor(0.05, dtype=torch.float64, requires_grad=True)
        few = camera[:5], ray[:5], camera[:5] + 45.0 * ray[:5]
        assert torch.autograd.gradcheck(lambda depth: moved(type(water)(depth, 2.0), *few), depth)


# Of the largest derivative of a kind. Measured worst: 5e-15 and 5e-15.
FIRST, SECOND = 5e-14, 5e-14
# Camera, point, level and index.
NUMBERS = [1.0, 2.0, 30.0, 8.0, 3.0, -3.0, 0.2, 1.333]
AMPLITUDES, VECTORS, PHASES = (0.02, 0.01), ((1.5, 0.3), (-0.6, 2.2)), (0.3, 1.0)
BOWL = 1e-3
NODES_DIGITS = np.random.default_rng(3).uniform(-0.05, 0.05, (9, 9))


def water_of(name, level, index):
    if name == "bowl":
        return Bowl(level, index, BOWL)
    return WavyWater((0.3, -0.2, level), AMPLITUDES, VECTORS, PHASES, n_water=index)


def height_of(name, level, x, y):
    """Height and slopes in mpmath."""
    if name == "bowl":
        return level + BOWL * (x * x + y * y), 2 * BOWL * x, 2 * BOWL * y
    x, y = x - mpmath.mpf(0.3), y + mpmath.mpf(0.2)
    z, zx, zy = level, mpmath.mpf(0), mpmath.mpf(0)
    for a, (kx, ky), phase in zip(AMPLITUDES, VECTORS, PHASES, strict=True):
        angle = kx * x + ky * y + phase
        z, zx, zy = z + a * mpmath.sin(angle), zx + a * kx * mpmath.cos(angle), zy + a * ky * mpmath.cos(angle)
    return z, zx, zy


def seen(name, numbers):
    found = project(numbers[3:6], numbers[:3], water_of(name, numbers[6], numbers[7]))
    return torch.cat([found.direction, found.crossing, torch.stack([found.air_length, found.water_length])])


def seen_exactly(name, numbers, start):
    """`seen` in mpmath: the crossing where the optical length is stationary."""
    camera, point, (level, n) = numbers[:3], numbers[3:6], numbers[6:]

    def legs(x, y):
        z, zx, zy = height_of(name, level, x, y)
        air, water = ([c - e for c, e in zip((x, y, z), end, strict=True)] for end in (camera, point))
        return air, mpmath.norm(air), water, mpmath.norm(water), zx, zy

    def gradient(x, y):
        air, a, water, w, zx, zy = legs(x, y)
        return [(air[k] + z * air[2]) / a + n * (water[k] + z * water[2]) / w for k, z in enumerate((zx, zy))]

    x, y = mpmath.findroot(gradient, start, tol=1e-80)
    air, a, water, w, _, _ = legs(x, y)
    return [*(v / a for v in air), *(p + v for p, v in zip(point, water, strict=True)), a, w]


def traced(name, numbers):
    ray = numbers[3:6] - numbers[:3]
    path = trace(numbers[:3], ray / ray.norm(), water_of(name, numbers[6], numbers[7]))
    return torch.cat([path.crossing, path.water_direction, path.air_length[None]])


def traced_exactly(name, numbers, start):
    camera, (level, n) = numbers[:3], numbers[6:]
    ray = [p - c for p, c in zip(numbers[3:6], camera, strict=True)]
    ray = [v / mpmath.norm(ray) for v in ray]

    def at(t):
        return [c + t * v for c, v in zip(camera, ray, strict=True)]

    t = mpmath.findroot(lambda t: at(t)[2] - height_of(name, level, *at(t)[:2])[0], start, tol=1e-80)
    _, zx, zy = height_of(name, level, *at(t)[:2])
    up = [v / mpmath.sqrt(1 + zx * zx + zy * zy) for v in (-zx, -zy, mpmath.mpf(1))]
    cosine = -sum(r * u for r, u in zip(ray, up, strict=True)) / n
    push = cosine - mpmath.sqrt(1 - 1 / n**2 + cosine**2)
    return [*at(t), *(r / n + push * u for r, u in zip(ray, up, strict=True)), t]


@pytest.mark.parametrize("name", ["wavy", slow("bowl")])
@pytest.mark.parametrize("way", ["project", "trace"])
def test_derivatives_over_curved_water_are_those_of_fifty_digits(way, name):
    numbers = torch.tensor(NUMBERS, dtype=torch.float64)
    if way == "project":
        told, exactly = seen, seen_exactly
        start = [mpmath.mpf(float(v)) for v in seen(name, numbers)[3:5]]
    else:
        told, exactly, start = traced, traced_exactly, mpmath.mpf(float(traced(name, numbers)[-1]))
    first, second = exact_derivatives(lambda v: exactly(name, v, start), NUMBERS)
    for mode in (jacrev, jacfwd):
        assert worst(mode(lambda v: told(name, v))(numbers), first) < FIRST
    assert worst(hessian(lambda v: told(name, v))(numbers), second) < SECOND
    assert worst(jacrev(jacrev(lambda v: told(name, v)))(numbers), second) < SECOND


@pytest.mark.slow
def test_second_derivatives_over_cubic_pieces_pass_the_check_of_torch():
    def told(numbers):
        water = BicubicWater((-20.0, -20.0), 5.0, numbers[6] + torch.tensor(NODES_DIGITS), n_water=numbers[7])
        found, ray = project(numbers[3:6], numbers[:3], water), numbers[3:6] - numbers[:3]
        path = trace(numbers[:3], ray / ray.norm(), water)
        return torch.cat([found.direction, found.crossing, path.crossing, path.water_direction])

    numbers = torch.tensor(NUMBERS, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradgradcheck(told, numbers, eps=1e-5, atol=1e-6)
