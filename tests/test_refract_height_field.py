"""Measured water surfaces: planes by parts against planes and waves, edges, and gaps without water."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from surface_rays import bed_points, cameras, falling_rays, view_angle

from refract import crossing_point, kernels, trace
from refract.curved.height_field import HeightFieldWater
from refract.curved.wavy import WavyWater
from refract.surfaces import FlatWater

FLAT = FlatWater((1.0, 2.0, 0.5), n_water=1.34, slope_x=0.01, slope_y=-0.02)
SWELL = WavyWater((0.0, 0.0, 0.0), (0.1, 0.05), ((0.5, 0.1), (-0.2, 0.9)), (0.3, 1.0))


def raster_of(water, spacing, half=30.0) -> HeightFieldWater:
    """`water` sampled on a square raster about (0, 0)."""
    x = np.arange(-half, half + 0.5 * spacing, spacing)
    return HeightFieldWater.from_raster(x, x, water.height(*np.meshgrid(x, x)), n_water=water.n_water)


def scattered(water, rng, count=300, half=80.0) -> HeightFieldWater:
    """`water` at scattered points and at the corners of a square."""
    points = np.concatenate(
        [rng.uniform(-half, half, (count, 2)), half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])]
    )
    return HeightFieldWater.from_points(points, water.height(*points.T), n_water=water.n_water)


def roof(fold) -> HeightFieldWater:
    """Two planes that meet along the y axis and rise (a trough, fold > 0) or fall (a ridge) away from it."""
    x = np.array([-10.0, 0.0, 10.0])
    return HeightFieldWater.from_raster(x, x, np.broadcast_to(fold * np.abs(x), (3, 3)))


def single(*values):
    return tuple(np.array([v]) for v in values)


@pytest.mark.parametrize("kind", ["raster", "falling raster", "points"])
def test_a_tilted_plane_is_flat_water(rng, kind):
    if kind == "points":
        water = scattered(FLAT, rng)
    else:
        x, y = np.linspace(-80.0, 80.0, 41), np.linspace(-80.0, 80.0, 23)
        x, y = (x[::-1], y[::-1]) if "falling" in kind else (x, y)
        water = HeightFieldWater.from_raster(x, y, FLAT.height(*np.meshgrid(x, y)), n_water=1.34)
    camera, ray = cameras(rng, 500), falling_rays(rng, 500)
    bed = rng.uniform(-30, 30, 500), rng.uniform(-30, 30, 500), rng.uniform(-10, 3, 500)
    # Heights of 1 m and coordinates of 80 m, some 30 roundings, divided by the cosine.
    np.testing.assert_allclose(water.intersect(camera, ray), FLAT.intersect(camera, ray), atol=1e-12)
    np.testing.assert_allclose(water.height(*bed[:2]), FLAT.height(*bed[:2]), atol=1e-13)
    for found, expected in zip(water.normal(*bed[:2]), FLAT.up, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-13)
    found, _, count = water.crossing(camera, bed, 4)
    np.testing.assert_allclose(found, FLAT.crossing(camera, bed, 4)[0], atol=1e-12)
    np.testing.assert_array_equal(count, 1)


@pytest.mark.parametrize("flattest_deg", [60.0, 88.0])
def test_the_first_meeting_is_never_skipped(rng, flattest_deg):
    """Against a walk along the ray in 20 000 steps, from the highest crest down."""
    steep = raster_of(WavyWater((0.0, 0.0, 0.0), (0.3, 0.2), ((2.0, 0.3), (-0.7, 2.5))), 0.25, half=8.0)
    camera, ray = cameras(rng, 40, (0.6, 1.5)), falling_rays(rng, 40, flattest_deg - 10.0, flattest_deg)
    found = steep.intersect(camera, ray)
    assert np.isfinite(found).sum() > 20
    # A ray that meets nothing leaves the raster: its last meeting is at the rim.
    rim = np.min(
        [np.where(d > 0, (8.0 - o) / d, (-8.0 - o) / d) for o, d in zip(camera[:2], ray[:2], strict=True)], axis=0
    )
    end = np.where(np.isfinite(found), found, rim)
    t = end * np.linspace(0.0, 1.0, 20_000, endpoint=False)[:, None]
    x, y, z = kernels.point_at_distance(camera, ray, t)
    assert np.all(z > steep.height(x.ravel(), y.ravel()).reshape(x.shape))
    x, y, z = (c[np.isfinite(found)] for c in kernels.point_at_distance(camera, ray, found))
    np.testing.assert_allclose(z, steep.height(x, y), atol=1e-13)


def test_the_walk_meets_the_triangle_that_a_look_at_all_of_them_finds(rng):
    """Rough scattered surfaces, cameras above them; and with gaps, cameras above and beside them."""
    for gaps in (0.0, 0.0, 0.1, 0.1):
        points = np.concatenate([rng.uniform(-9, 9, (40, 2)), 9.0 * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])])
        heights = np.where(rng.uniform(size=44) < gaps, np.nan, rng.normal(0.0, 0.3, 44))
        water = HeightFieldWater.from_points(points, heights)
        camera, ray = (
            cameras(rng, 200, (1.0, 20.0), spread=14.0 if gaps else 8.0),
            falling_rays(rng, 200, flattest_deg=88.0),
        )
        found = water.intersect(camera, ray)
        wet = np.flatnonzero(water.wet_triangles)
        (x, y, z), (slope_x, slope_y) = water.planes(wet, camera[0])
        (ox, oy, oz), (dx, dy, dz) = (tuple(c[:, None] for c in v) for v in (camera, ray))
        rate = dz - slope_x * dx - slope_y * dy
        t = -(oz - z - slope_x * (ox - x) - slope_y * (oy - y)) / rate
        at = ox + t * dx, oy + t * dy
        inside = water.mesh.offsets(np.broadcast_to(wet, t.shape), *at).min(axis=-1) >= -1e-11
        first = np.where(inside & (rate < 0.0) & (t >= 0.0), t, np.inf).min(axis=-1)
        met = np.isfinite(found)
        np.testing.assert_allclose(found[met], first[met], rtol=1e-12)
        # A ray that comes in through a bank or from outside, below the level of the water, is refused.
        assert np.count_nonzero(~met & np.isfinite(first)) <= (2 if gaps else 0)


def test_project_returns_the_traced_ray_where_there_is_one_path(rng):
    water = raster_of(SWELL, 0.5)
    camera, ray = cameras(rng, 500, (5.0, 20.0)), falling_rays(rng, 500, flattest_deg=45.0)
    bed = bed_points(water, camera, ray, rng.uniform(0.05, 4.0, 500))
    found, _, count = water.crossing(camera, bed, 4)
    assert (count == 1).mean() > 0.9
    assert view_angle(camera, found, ray)[count == 1].max() < 1e-12


def test_a_finer_raster_tends_to_the_smooth_surface(rng):
    """Heights to second order in the spacing, normals and with them crossings to first."""
    camera, ray = cameras(rng, 200, (5.0, 20.0)), falling_rays(rng, 200, flattest_deg=30.0)
    bed = bed_points(SWELL, camera, ray, rng.uniform(0.5, 2.0, 200))
    distance, angle = [], []
    for spacing in (0.5, 0.25, 0.125):
        water = raster_of(SWELL, spacing, half=15.0)
        distance.append(np.sqrt(np.mean((water.intersect(camera, ray) - SWELL.intersect(camera, ray)) ** 2)))
        angle.append(np.sqrt(np.mean(view_angle(camera, water.crossing(camera, bed, 4)[0], ray) ** 2)))
    np.testing.assert_allclose(np.divide(distance[:-1], distance[1:]), 4.0, rtol=0.15)
    np.testing.assert_allclose(np.divide(angle[:-1], angle[1:]), 2.0, rtol=0.15)


def test_over_a_ridge_two_paths_and_the_shorter_is_taken():
    water = roof(-0.1)
    _, _, count = water.crossing(single(0.0, 0.5, 10.0), single(0.0, 0.3, -2.0), 4)
    assert count[0] == 2
    (x, _, _), _, count = water.crossing(single(0.0, 0.5, 10.0), single(0.01, 0.3, -2.0), 4)
    assert count[0] == 2
    assert x[0] > 0.0
    _, _, count = water.crossing(single(0.0, 0.5, 10.0), single(1.0, 0.3, -2.0), 4)
    assert count[0] == 1


def test_in_a_trough_the_edge_stands_for_its_round_bottom():
    """A strip of the bed that no ray of either plane reaches is seen at the edge, as over a narrow round trough."""
    water = roof(0.1)
    for x in (0.0, 0.02, 0.04):
        (at, y, z), _, count = water.crossing(single(0.0, 0.5, 10.0), single(x, 0.3, -2.0), 4)
        assert count[0] == 1
        assert at[0] == 0.0
        assert z[0] == 0.0
        flat, _, _ = FlatWater((0.0, 0.0, 0.0)).crossing(single(0.0, 0.5, 10.0), single(0.0, 0.3, -2.0), 4)
        assert abs(y[0] - flat[1][0]) < 1e-4  # the leg in water leans over by x
    (at, _, _), _, count = water.crossing(single(0.0, 0.5, 10.0), single(0.5, 0.3, -2.0), 4)
    assert count[0] == 1
    assert at[0] > 0.0


def test_a_pit_of_four_planes_is_seen_through_its_corner():
    x = np.array([-1.0, 0.0, 1.0])
    heights = 0.1 * (np.abs(x)[:, None] + np.abs(x))
    water = HeightFieldWater.from_raster(x, x, heights)
    found, _, count = water.crossing(single(0.0, 0.0, 10.0), single(0.001, -0.001, -2.0), 4)
    np.testing.assert_array_equal(np.ravel(found), 0.0)
    assert count[0] == 1


def test_the_shortest_path_is_that_of_a_dense_grid(rng):
    water = raster_of(WavyWater((0.0, 0.0, 0.0), (0.08, 0.05), ((2.0, 0.3), (-0.7, 3.0))), 0.3, half=9.0)
    ways = np.linspace(-2.0, 2.0, 401)
    for _ in range(4):
        camera, point = np.array([*rng.uniform(-4, 4, 2), 12.0]), np.array([*rng.uniform(-2, 2, 2), -rng.uniform(1, 4)])
        found, _, count = water.crossing(single(*camera), single(*point), 4)
        assert count[0] >= 1

        def length(x, y, camera=camera, point=point):
            s = np.stack([x, y, water.height(x, y)], -1)
            return np.linalg.norm(s - camera, axis=-1) + water.n_water * np.linalg.norm(s - point, axis=-1)

        x, y = np.meshgrid(point[0] + ways, point[1] + ways)
        lengths = length(x.ravel(), y.ravel())
        assert length(found[0], found[1])[0] <= lengths.min() + 1e-13
        best = x.ravel()[lengths.argmin()], y.ravel()[lengths.argmin()]
        assert math.hypot(best[0] - found[0][0], best[1] - found[1][0]) < 0.05


def test_rays_and_points_over_dry_land_meet_no_water():
    x = np.arange(-6.0, 6.5, 1.0)
    heights = np.zeros((13, 13))
    heights[:, 7:9] = np.nan  # a bank from x = 1 to 2; triangles dry from 0 to 3
    water = HeightFieldWater.from_raster(x, x, heights)
    camera = np.array([1.5, 0.3, 5.0])
    aim = np.array([[1.5, 0.3, 0.0], [-2.0, 0.3, 0.0], [4.0, 0.3, 0.0], [40.0, 0.3, 0.0], [7.0, 0.3, 0.0]])
    way = aim - camera
    paths = trace(camera, way / np.linalg.norm(way, axis=-1, keepdims=True), water)
    np.testing.assert_array_equal(paths.wet, [False, True, True, False, False])
    np.testing.assert_allclose(paths.crossing[1:3], aim[1:3], atol=1e-14)
    assert np.isnan(water.height(*single(1.5, 0.0))[0])
    point = np.array([[1.5, 0.3, -1.0], [-3.0, 0.3, -1.0]])
    seen = crossing_point(point, camera, water)
    np.testing.assert_array_equal(seen[0], point[0])  # under dry land: the ray is straight
    assert abs(seen[1, 2]) < 1e-15


def test_a_path_that_would_cross_dry_land_is_none():
    """A bed point close to the bank, whose ray would leave the water where there is none."""
    x = np.arange(-6.0, 6.5, 1.0)
    heights = np.zeros((13, 13))
    heights[:, 7:] = np.nan  # water ends at x = 0
    found, depth, count = HeightFieldWater.from_raster(x, x, heights).crossing(
        single(20.0, 0.0, 5.0), single(-0.1, 0.0, -3.0), 4
    )
    assert depth[0] == 3.0
    assert count[0] == 0
    assert np.isnan(found[0][0])


def test_a_camera_beside_the_raster_sees_into_it():
    water = raster_of(FlatWater((0.0, 0.0, 0.0)), 1.0, half=5.0)
    camera, point = single(-20.0, 0.1, 15.0), single(1.0, 0.2, -1.0)
    expected, _, _ = FlatWater((0.0, 0.0, 0.0)).crossing(camera, point, 4)
    np.testing.assert_allclose(water.crossing(camera, point, 4)[0], expected, atol=1e-13)


def test_gradients_flow_to_heights_rays_and_index(rng):
    heights = torch.tensor(rng.uniform(0.0, 0.05, (4, 5)), requires_grad=True)
    index = torch.tensor(1.333, dtype=torch.float64, requires_grad=True)
    camera = tuple(torch.tensor([c], dtype=torch.float64, requires_grad=True) for c in (0.3, 0.2, 8.0))
    bed = tuple(torch.tensor([c], dtype=torch.float64, requires_grad=True) for c in (1.23, 0.71, -1.0))

    def crossing(heights, index, *ends):
        water = HeightFieldWater.from_raster(np.arange(5.0) - 1.0, np.arange(4.0) - 1.0, heights, n_water=index)
        return torch.stack(water.crossing(ends[:3], ends[3:], 4)[0])

    def distance(heights, *origin):
        water = HeightFieldWater.from_raster(np.arange(5.0) - 1.0, np.arange(4.0) - 1.0, heights)
        ray = tuple(torch.tensor([c], dtype=torch.float64) for c in (0.08, 0.06, -math.sqrt(0.99)))
        return water.intersect(origin, ray)

    assert torch.autograd.gradcheck(crossing, (heights, index, *camera, *bed), eps=1e-6, atol=1e-6)
    assert torch.autograd.gradcheck(distance, (heights, *camera), eps=1e-6, atol=1e-6)


def test_gaps_leave_the_gradients_of_the_rest_alone():
    x = np.arange(-6.0, 6.5, 1.0)
    values = np.zeros((13, 13))
    values[:, :4] = np.nan  # the first triangles are dry
    heights = torch.tensor(values, requires_grad=True)
    water = HeightFieldWater.from_raster(x, x, heights)
    camera = tuple(torch.tensor([c, c], dtype=torch.float64, requires_grad=True) for c in (0.3, 0.2, 8.0))
    point = tuple(
        torch.tensor(c, dtype=torch.float64, requires_grad=True) for c in ([-4.5, 1.1], [0.3, 0.4], [-1.0, -1.0])
    )
    ray = tuple(torch.tensor(c, dtype=torch.float64) for c in ([-0.6, 0.28], [0.0, 0.0], [-0.8, -0.96]))
    total = sum(c.nansum() for c in water.crossing(camera, point, 4)[0]) + water.intersect(camera, ray).nansum()
    (total + water.height(*point[:2]).nansum() + sum(c.nansum() for c in water.normal(*point[:2]))).backward()
    assert all(torch.isfinite(leaf.grad).all() for leaf in (heights, *camera, *point))
    assert heights.grad.abs().max() > 0.1


def test_torch_agrees_with_numpy(rng):
    water = raster_of(SWELL, 1.0)
    camera, ray = cameras(rng, 100, (5.0, 20.0)), falling_rays(rng, 100, flattest_deg=45.0)
    ray = tuple(torch.tensor(c) for c in ray), ray
    ends = tuple(map(torch.tensor, camera))
    found = water.intersect(ends, ray[0])
    np.testing.assert_allclose(found.numpy(), water.intersect(camera, ray[1]), rtol=1e-14)


def test_drjit_is_told_where_to_go():
    pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    from drjit.llvm.ad import Float

    with pytest.raises(TypeError, match="numpy and torch"):
        roof(0.1).height(Float(1.0), Float(2.0))


def test_wrong_numbers_are_named():
    x = np.arange(3.0)
    with pytest.raises(ValueError, match=r"got \(2, 3\), \(3,\) and \(3,\)"):
        HeightFieldWater.from_raster(x, x, np.zeros((2, 3)))
    with pytest.raises(ValueError, match="rise or fall"):
        HeightFieldWater.from_raster(np.array([0.0, 2.0, 1.0]), x, np.zeros((3, 3)))
    with pytest.raises(ValueError, match="three finite heights"):
        HeightFieldWater.from_raster(x, x, np.full((3, 3), np.nan))
    with pytest.raises(ValueError, match="fill the convex hull"):
        HeightFieldWater(np.array([[0, 0], [1, 0], [1, 1], [0, 1]]), np.zeros(4), [[0, 1, 2]])
    with pytest.raises(ValueError, match=r"heights \(points,\)"):
        HeightFieldWater(np.zeros((4, 2)), np.zeros(3), [[0, 1, 2]])
    with pytest.raises(ValueError, match=r"0\.5"):
        HeightFieldWater.from_raster(x, x, np.zeros((3, 3)), n_water=0.5)


@pytest.mark.parametrize("points", [[(0.0, 0.0), (1.0, 0.0)], [(0.0, 0.0), (1.0, 1.0), (2.0, 2.0)], [(0.0, 0.0)] * 5])
def test_points_that_span_no_area_are_refused(points):
    with pytest.raises(ValueError, match="not on one line"):
        HeightFieldWater.from_points(points, np.zeros(len(points)))
