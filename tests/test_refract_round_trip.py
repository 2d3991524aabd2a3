"""There and back over all geometries, libraries and precisions; digits at the edge; where a point appears."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from surface_rays import DOUBLE, LIBRARIES, array_of, as_double

from refract import FlatWater, PinholeCamera, bend, crossing_point, kernels, project, trace
from refract.surfaces import ENOUGH_STEPS_DOUBLE, ENOUGH_STEPS_SINGLE

EPS = np.finfo(np.float64).eps
EPS32 = np.finfo(np.float32).eps
INDICES = (1.0, 1.0001, 1.1, 1.2, 1.333, 1.39, 1.6)
# Measured worst: 1.6e-14 (index 1.0001, 1 mm over 1 km of water, 89.9 deg).
DOUBLE_RAD = 1e-12
# The point in float32 is a rounding away from the ray: half a unit of a coordinate of 1024 m and more is 6.1e-5 m,
# and from 1 mm over 1 km of water at 89.4 deg the ray turns by 1 rad per 31 m, so 1.97e-6. Found by search: 1.96e-6.
SINGLE_RAD = 2e-6
# What is left without that: rounding of the direction itself.
SOLVER_RAD = 2 * EPS32


def geometry():
    """Heights, depths, incidences and azimuths, (K,) each: logarithmic over all of the range, corners included."""
    H = np.geomspace(1e-3, 1e4, 12)
    h = np.concatenate([[0.0], np.geomspace(1e-6, 1e3, 10)])
    from_grazing = 90.0 - np.geomspace(0.1, 20.0, 25)
    angle = np.radians(np.concatenate([[0.0, 1e-6, 1e-3], np.linspace(1.0, 75.0, 12), from_grazing]))
    azimuth = np.array([0.0, 0.45, 0.8, 1.2])
    return tuple(v.ravel() for v in np.meshgrid(H, h, angle, azimuth, indexing="ij"))


def angle_between(a, b):
    """Angle [rad] between vectors (K, 3) of about any length, accurate for small ones."""
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), np.sum(a * b, axis=-1))


def there_and_back(kind, n):
    """Rays, the points where they end, and the directions in which those appear, as float64 (K, 3)."""
    H, h, angle, azimuth = geometry()
    sine = np.sin(angle)
    rays = array_of(kind, np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), -np.cos(angle)], axis=-1))
    centres, water = array_of(kind, np.stack([0.0 * H, 0.0 * H, H], axis=-1)), FlatWater((0.0, 0.0, 0.0), n_water=n)
    points = trace(centres, rays, water).at_height(array_of(kind, -h), water)
    seen = project(points, centres, water)
    assert np.isfinite(as_double(seen.direction)).all()
    return as_double(rays), as_double(points), as_double(centres), as_double(seen.direction)


@pytest.mark.parametrize("n", INDICES)
@pytest.mark.parametrize("kind", DOUBLE)
def test_project_returns_the_traced_ray_in_float64(kind, n):
    rays, _, _, directions = there_and_back(kind, n)
    assert angle_between(rays, directions).max() < DOUBLE_RAD


@pytest.mark.parametrize("n", INDICES)
def test_project_returns_the_traced_ray_in_float32(n):
    rays, points, centres, directions = there_and_back("torch.float32", n)
    assert angle_between(rays, directions).max() < SINGLE_RAD
    # Against the direction in which the point that was kept appears, to the last digit of float64.
    exact = project(points, centres, FlatWater((0.0, 0.0, 0.0), n_water=n)).direction
    assert angle_between(exact, directions).max() < SOLVER_RAD
    assert np.abs(np.linalg.norm(directions, axis=-1) - 1.0).max() < 3 * EPS32


@pytest.mark.parametrize("kind", LIBRARIES)
def test_index_one_gives_the_straight_ray(rng, kind):
    """To the last bit down, in torch to one unit in the last place, since its roots are not rounded correctly on every
    processor; up to 4 units, against the unit vector from camera to point."""
    rays = rng.normal(size=(5000, 3)) - [0.0, 0.0, 1.0]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    points, centre = rng.uniform([-30, -30, -9], [30, 30, 1], (5000, 3)), np.array([1.0, 2.0, 35.0])
    water = FlatWater((0.0, 0.0, 2.0), n_water=1.0, slope_x=0.01, slope_y=-0.02)
    centres = array_of(kind, np.tile(centre, (5000, 1)))
    path = trace(centres, array_of(kind, rays), water)
    unit = EPS32 if kind == "torch.float32" else EPS
    down = np.abs(as_double(path.water_direction) - as_double(path.air_direction))
    assert down.max() <= (unit if kind.startswith("torch") else 0.0)
    points = as_double(array_of(kind, points))
    straight = (points - centre) / np.linalg.norm(points - centre, axis=-1, keepdims=True)
    found = as_double(project(array_of(kind, points), centres, water).direction)
    assert np.abs(found - straight).max() <= 4 * unit / 2  # components of up to one have units of eps / 2


def converged(terms, like=None):
    """Angle in air [rad] for problems in their three numbers, after 0 to 8 steps of the solver."""
    a, b_squared, h = terms
    # n H = a and (n^2 - 1) D^2 = b^2, at an index of 1.333
    n = 1.333
    D_squared = b_squared / (n * n - 1.0)
    shares = [kernels.air_share(D_squared, a / n, h, n, steps, like) for steps in range(9)]
    return [np.arctan2(u * np.sqrt(D_squared), a / n) for u in shares]


def test_a_few_steps_reach_the_root_wherever_it_lies():
    """The problem has two numbers, h / a and b / a; this covers their plane, and the ridge where both are large."""
    rho = np.geomspace(1e-12, 1e12, 400)[:, None]
    eta = np.concatenate([np.geomspace(1e-12, 1e12, 400)[None, :] + 0.0 * rho, rho * np.linspace(0.5, 1.5, 401)], 1)
    angles = converged((np.ones_like(eta), eta**2, rho + 0.0 * eta))
    assert all(np.isfinite(a).all() for a in angles)
    error = [np.abs(a - angles[-1]).max() for a in angles]
    assert error[0] < 0.13
    assert error[2] < 1e-4
    # At a ratio of 1e12 the problem itself is not known better.
    assert error[ENOUGH_STEPS_DOUBLE] < 1e-9


def test_in_float32_the_last_step_gains_what_rounding_lost():
    rho = np.geomspace(1e-12, 1e6, 400)[:, None]  # 1 mm over 1 km of water
    eta = np.concatenate([np.geomspace(1e-12, 1e7, 400)[None, :] + 0.0 * rho, rho * np.linspace(0.5, 1.5, 401)], 1)
    terms = (np.ones_like(eta), eta**2, rho + 0.0 * eta)
    exact = converged(terms)[-1]
    found = converged(terms, like=np.ones(1, np.float32))[ENOUGH_STEPS_SINGLE]
    assert np.abs(found - exact).max() < 1e-9  # against 6e-8 of float32; measured 5e-11


def test_float32_far_from_the_origin_costs_the_rounding_of_the_coordinates(rng):
    """Half a unit in the last place of each, over the length of the air leg; the same in camera and point."""
    offset, legs = np.array([900.0, -700.0, 40.0]), np.array([0.0, 0.0, 30.0])
    water = FlatWater(tuple(offset), n_water=1.34)
    rays = rng.normal(size=(5000, 3)) * [0.4, 0.4, 0.0] - [0.0, 0.0, 1.0]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    centre = torch.tensor(offset + legs).float()
    points = trace(centre, torch.tensor(rays).float(), water).at_height(torch.tensor(-4.0), water)
    seen = project(points, centre, water).direction.double().numpy()
    step = 2.0**-15  # half a unit of coordinates of 512 m to 1024 m
    assert angle_between(seen, rays).max() < math.sqrt(3.0) * step / 30.0 + 4 * EPS32


WATER = FlatWater((0.0, 0.0, 0.0), n_water=1.333)
CENTRE = np.array([0.0, 0.0, 30.0])
RAY = np.array([0.6, 0.0, -0.8])


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0 - 1e-4, 1.0 + 1e-4, 2.0, 1e200])
@pytest.mark.parametrize("water", [WATER, None])
def test_a_direction_whose_length_is_not_one_is_invalid(factor, water):
    path = trace(CENTRE, np.stack([RAY, factor * RAY]), water)
    np.testing.assert_array_equal(np.isnan(path.air_length), [False, True])
    assert np.isnan(path.water_direction[1]).all()
    assert np.isnan(path.crossing[1]).all()
    assert np.isnan(path.at(3.0)[1]).all()
    assert np.isnan(path.at_height(1.0, water)[1]).all()


def test_the_rounding_of_a_direction_is_not_its_length():
    ray = RAY.astype(np.float32)[None] * np.float32(1.0 + 3e-7)
    assert trace(torch.tensor(CENTRE).float(), torch.tensor(ray), WATER).wet.all()
    assert trace(CENTRE, RAY * (1.0 + 4e-6), WATER).wet


def test_bend_refuses_rays_and_normals_whose_length_is_not_one():
    rays, normals = np.stack([RAY, 2.0 * RAY, RAY]), np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 3.0]])
    bent = bend(rays, normals, n_from=1.0, n_to=1.333)
    np.testing.assert_array_equal(np.isnan(bent).all(axis=-1), [False, True, True])


@pytest.mark.parametrize(("n_from", "n_to"), [(1.0, 0.0), (0.0, 1.0), (1.0, -1.3), (math.nan, 1.0), (1.0, math.inf)])
def test_indices_that_are_not_positive_and_finite_are_named(n_from, n_to):
    with pytest.raises(ValueError, match="finite refractive indices above zero"):
        bend(RAY, np.array([0.0, 0.0, 1.0]), n_from=n_from, n_to=n_to)


TINY = [10.0**power for power in range(-44, 0)] + [0.0, 5e-324, 1e-300, 1e-154, 1e-102]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("where", ["depth", "height", "aside"])
def test_no_tiny_length_makes_the_gradient_of_a_shared_camera_nan(dtype, where):
    for tiny in TINY:
        point, centre = [5.0, 1.0, -3.0], [0.0, 0.0, 30.0]
        if where == "depth":
            point[2] = -tiny
        elif where == "height":
            centre[2] = tiny
        else:
            point[0], point[1] = tiny, 0.0
        points = torch.tensor([[1.0, 2.0, -3.0], point], dtype=dtype)
        camera, level = (torch.tensor(v, dtype=dtype, requires_grad=True) for v in (centre, 0.0))
        seen = project(points, camera, FlatWater((0.0, 0.0, level), n_water=1.333))
        told = (seen.direction, seen.crossing, seen.air_length, seen.water_length, seen.depth)
        sum(v[torch.isfinite(v)].sum() for v in told).backward()
        assert torch.isfinite(camera.grad).all(), tiny
        assert torch.isfinite(level.grad), tiny


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.1, -0.02)])
def test_directions_keep_their_digits_far_from_the_origin(rng, slopes):
    """Whole metres: adding them to coordinates of 2^-20 m costs no rounding, so nothing may change."""
    away = np.array([5e6, -3e6, 100.0])
    points = np.round(rng.uniform([-30, -30, -9], [30, 30, -4], (500, 3)) * 2.0**20) / 2.0**20
    here, there = (
        FlatWater(tuple(place), n_water=1.333, slope_x=slopes[0], slope_y=slopes[1]) for place in (0 * away, away)
    )
    near, far = project(points, CENTRE, here), project(points + away, CENTRE + away, there)
    for name in ("direction", "air_length", "water_length", "depth"):
        np.testing.assert_array_equal(getattr(far, name), getattr(near, name))


def test_float32_has_the_camera_gradients_of_float64_close_over_deep_water():
    """2 mm over the water and 610 m of it, where absolute coordinates cost 3 % of the gradient."""
    points = torch.tensor([[300.0, 120.0, -610.0]], dtype=torch.float64)
    found = []
    for dtype in (torch.float32, torch.float64):
        camera = torch.tensor([0.0, 0.0, 2e-3], dtype=torch.float32).to(dtype).requires_grad_()
        project(points.to(dtype), camera, WATER).direction.sum().backward()
        found.append(camera.grad.double().numpy())
    np.testing.assert_allclose(found[0], found[1], rtol=1e-6)  # sums of three derivatives, each rounded once


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.02, -0.01), (0.2, 0.1)])
@pytest.mark.parametrize("away", [0.0, 5000.0])
def test_float32_traces_as_float64_and_rounds_at_the_end(rng, slopes, away):
    """Also where the point of a tilted plane lies far away; three roundings for the direction, one for the rest."""
    level = away * (slopes[0] - slopes[1])
    water = FlatWater((away, -away, level), n_water=1.34, slope_x=slopes[0], slope_y=slopes[1])
    rays = rng.normal(size=(2000, 3)) * [0.3, 0.3, 0.0] - [0.0, 0.0, 1.0]
    rays = torch.tensor(rays / np.linalg.norm(rays, axis=-1, keepdims=True), dtype=torch.float32)
    centre = torch.tensor([1.0, 2.0, 60.0], dtype=torch.float32)
    found, exact = trace(centre, rays, water), trace(centre.double(), rays.double(), water)
    half_unit = 2.0**-24
    assert ((found.crossing - exact.crossing).abs() <= 1.01 * half_unit * exact.crossing.abs() + 1e-12).all()
    assert ((found.air_length - exact.air_length).abs() <= 1.01 * half_unit * exact.air_length).all()
    assert (found.water_direction - exact.water_direction).abs().max() < 4 * half_unit


ORACLE_FOCAL_PX = 1662.7687752661222  # ground_truth.json of aquacal_oracle, 1920 x 1080


def test_crossings_of_another_package_are_met(data_dir):
    """AquaCal's world has z down into the water; half a turn about x makes it ours."""
    vectors = data_dir / "real" / "aquacal_oracle" / "aquacal_1.0.2_vectors.csv"
    rows = np.genfromtxt(vectors, delimiter=",", names=True)
    assert len(rows) == 163
    half_turn = np.diag([1.0, -1.0, -1.0])
    for row in rows:

        def xyz(*names, row=row):
            return half_turn @ np.array([row[name] for name in names])

        water = FlatWater((0.0, 0.0, -row["water_z"]), n_water=row["n_water"])
        rotation = Rotation.from_rotvec([row["rvx"], row["rvy"], row["rvz"]]).as_matrix() @ half_turn
        camera = PinholeCamera(
            xyz("Cx", "Cy", "Cz"), rotation, ORACLE_FOCAL_PX, ORACLE_FOCAL_PX, 960.0, 540.0, 1920, 1080
        )
        entry, bed = xyz("ix", "iy", "iz"), xyz("Px", "Py", "Pz")
        np.testing.assert_allclose(crossing_point(bed, camera.centre, water), entry, atol=1e-12)
        np.testing.assert_allclose(camera.project(bed, water), [row["u"], row["v"]], atol=1e-9)
        path = camera.paths(np.array([row["u"], row["v"]]), water)
        np.testing.assert_allclose(path.crossing, entry, atol=1e-12)
        np.testing.assert_allclose(path.water_direction, xyz("dx", "dy", "dz"), atol=1e-12)


@pytest.mark.parametrize(
    ("water", "camera_z", "heights"),
    [(WATER, 35.0, (0.0, 9.0)), (None, 35.0, (-9.0, 9.0)), *((WATER, z, (-9.0, 3.0)) for z in (0.0, -0.5, -20.0))],
    ids=["points above", "no water", "camera on the surface", "camera below", "camera deep"],
)
def test_points_that_are_seen_straight_are_their_own_crossing(rng, water, camera_z, heights):
    points = rng.uniform([-30.0, -30.0, heights[0]], [30.0, 30.0, heights[1]], (100, 3))
    points[0, 2] = heights[0]
    np.testing.assert_array_equal(crossing_point(points, np.array([1.0, 2.0, camera_z]), water), points)


def test_crossing_and_point_meet_as_the_depth_goes_to_zero():
    water, centre = FlatWater((0.0, 0.0, 0.0), n_water=1.333), np.array([0.0, 0.0, 30.0])
    depth = np.array([0.0, 1e-300, 1e-15, 1e-9, 1e-6, 1e-3])
    points = np.stack([np.full(6, 20.0), np.zeros(6), -depth], axis=-1)
    shift = 20.0 - crossing_point(points, centre, water)[:, 0]
    tangent_in_water = 20.0 / math.sqrt(1.333**2 * (20.0**2 + 30.0**2) - 20.0**2)
    # 1e-14: coordinates of 20 m; the share of the depth grows by h / H, 3e-5 at 1 mm
    np.testing.assert_allclose(shift, depth * tangent_in_water, rtol=1e-4, atol=1e-14)
