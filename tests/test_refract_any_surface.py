"""Surfaces that know only height and normal, and cubic pieces over a raster: against surfaces that know all."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.func import jacfwd, jacrev, vmap

from refract import FlatWater, LayeredPath, ParallelLayers, Regime, project, trace
from refract.curved import AnySurface, BicubicWater, HeightFieldWater, SphericalWater, WavyWater

CENTRE = np.array([1.0, -2.0, 40.0])
WAVES = WavyWater((0.0, 0.0, 0.0), (0.05, 0.03), ((1.0, 0.5), (-0.4, 0.8)))
SURFACES = {
    "tilted": FlatWater((0.0, 0.0, 0.3), slope_x=0.05, slope_y=-0.02),
    "sphere": SphericalWater((0.0, 0.0, 0.3), 5000.0),
    "waves": WAVES,
}
NEAR_M = 1e-12  # coordinates of 60 m, some twenty roundings; measured worst 1.4e-14


class Veiled(AnySurface):
    """Of another surface only its height and normal."""

    def __init__(self, surface):
        self.surface, self.n_water = surface, surface.n_water

    def height(self, x, y):
        return self.surface.height(x, y)

    def normal(self, x, y):
        return self.surface.normal(x, y)


def rays_and_points(rng, count=300):
    rays = np.concatenate([rng.uniform(-0.8, 0.8, (count, 2)), -np.ones((count, 1))], axis=-1)
    points = rng.uniform([-30, -30, -6], [30, 30, -1], (count, 3))
    return rays / np.linalg.norm(rays, axis=-1, keepdims=True), points


@pytest.mark.parametrize("library", ["numpy", "torch"])
@pytest.mark.parametrize("name", SURFACES)
def test_height_and_normal_are_enough(rng, name, library):
    surface, (rays, points) = SURFACES[name], rays_and_points(rng)
    expected = trace(CENTRE, rays, surface), project(points, CENTRE, surface)
    if library == "torch":
        rays, points = torch.tensor(rays), torch.tensor(points)
    path, seen = trace(CENTRE, rays, Veiled(surface)), project(points, CENTRE, Veiled(surface))
    np.testing.assert_allclose(path.crossing, expected[0].crossing, atol=NEAR_M)
    np.testing.assert_allclose(path.water_direction, expected[0].water_direction, atol=NEAR_M)
    np.testing.assert_allclose(seen.crossing, expected[1].crossing, atol=NEAR_M)
    assert (np.asarray(seen.num_paths) == 1).all()


def test_drjit_needs_no_more_either(rng):
    drjit = pytest.importorskip("drjit", reason="Dr.Jit is not installed")
    if not drjit.has_backend(drjit.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM; install libllvm19 or set DRJIT_LIBLLVM_PATH")
    from drjit.llvm.ad import Array3f64

    rays, points = rays_and_points(rng, 20)
    centre = Array3f64(*map(float, CENTRE))
    path = trace(centre, Array3f64(rays.T), Veiled(WAVES))
    seen = project(Array3f64(points.T), centre, Veiled(WAVES))
    np.testing.assert_allclose(np.asarray(path.crossing).T, trace(CENTRE, rays, WAVES).crossing, atol=NEAR_M)
    np.testing.assert_allclose(np.asarray(seen.crossing).T, project(points, CENTRE, WAVES).crossing, atol=NEAR_M)


def test_gradients_through_any_surface_are_those_of_the_surface(rng):
    rays, points = (torch.tensor(v) for v in rays_and_points(rng, 20))
    gradients = []
    for veil in (Veiled, lambda surface: surface):
        leaves = [torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (CENTRE, 0.1, 1.33, 0.05)]
        camera, level, index, height = leaves
        water = veil(WavyWater((0.0, 0.0, level), (height, 0.03), ((1.0, 0.5), (-0.4, 0.8)), n_water=index))
        told = trace(camera, rays, water).water_direction.sum() + project(points, camera, water).direction.sum()
        gradients.append(torch.autograd.grad(told, leaves))
    for one, other in zip(*gradients, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-8, atol=1e-10)


def test_rays_and_points_that_miss_are_told_so():
    water = Veiled(WAVES)
    rays = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [np.nan, 0.0, -1.0], [0.0, 0.0, -1.0]])
    expected = [Regime.STRAIGHT, Regime.STRAIGHT, Regime.INVALID, Regime.BENT]
    np.testing.assert_array_equal(trace(CENTRE, rays, water).regime, expected)
    points = np.array([[0.0, 0.0, 3.0], [np.nan, 0.0, -1.0], [0.0, 0.0, -2.0]])
    seen = project(points, CENTRE, water)
    np.testing.assert_array_equal(seen.regime, [Regime.STRAIGHT, Regime.INVALID, Regime.BENT])
    np.testing.assert_array_equal(seen.crossing[0], points[0])


def raster(kind, spacing, surface=WAVES, half=24.0):
    x = np.arange(-half, half + 0.5 * spacing, spacing)
    heights = surface.height(*np.meshgrid(x, x))
    if kind is BicubicWater:
        return BicubicWater((-half, -half), spacing, heights, n_water=surface.n_water)
    return HeightFieldWater.from_raster(x, x, heights, n_water=surface.n_water)


@pytest.mark.parametrize(("kind", "order", "stated_rad"), [(BicubicWater, 2.0, 2e-5), (HeightFieldWater, 1.0, 4e-4)])
def test_directions_converge_in_the_stated_order(rng, kind, order, stated_rad):
    points = rng.uniform([-15, -15, -6], [15, 15, -1], (200, 3))
    exact = project(points, CENTRE, WAVES).direction
    errors = [
        np.sqrt(np.mean((project(points, CENTRE, raster(kind, spacing)).direction - exact) ** 2))
        for spacing in (1.0, 0.5, 0.25)
    ]
    assert errors[-1] < stated_rad
    assert abs(np.log2(errors[0] / errors[-1]) / 2.0 - order) < 0.25


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


@pytest.mark.slow
def test_gradients_flow_to_the_heights_of_the_nodes():
    heights = torch.tensor(raster(BicubicWater, 4.0, half=8.0).heights, requires_grad=True)
    points = torch.tensor([[1.0, 2.0, -3.0], [-2.5, 0.3, -4.0]], dtype=torch.float64)

    def seen(heights):
        return project(points, torch.tensor(CENTRE), BicubicWater((-8.0, -8.0), 4.0, heights)).direction

    assert torch.autograd.gradcheck(seen, heights, eps=1e-6, atol=1e-8)


def test_wrong_rasters_are_named():
    for arguments, message in (
        (((0.0, 0.0), 1.0, np.zeros((2, 5))), r"\(2, 5\)"),
        (((0.0, 0.0), 0.0, np.zeros((4, 5))), "positive spacing"),
    ):
        with pytest.raises(ValueError, match=message):
            BicubicWater(*arguments)
    with pytest.raises(ValueError, match="index of water"):
        BicubicWater((0.0, 0.0), 1.0, np.zeros((4, 5)), n_water=0.9)


@pytest.mark.parametrize("kind", [BicubicWater, HeightFieldWater])
def test_what_lies_beside_a_raster_is_straight(kind):
    water = raster(kind, 1.0)
    beside = np.array([[200.0, 0.0, -3.0], [3.0, 1.0, -3.0]])
    seen = project(beside, CENTRE, water)
    np.testing.assert_array_equal(seen.regime, [Regime.STRAIGHT, Regime.BENT])
    assert (seen.depth[0], seen.num_paths[0]) == (0.0, 1)
    np.testing.assert_array_equal(seen.crossing[0], beside[0])
    ray = (beside - CENTRE) / np.linalg.norm(beside - CENTRE, axis=-1, keepdims=True)
    np.testing.assert_array_equal(trace(CENTRE, ray, water).regime, [Regime.STRAIGHT, Regime.BENT])


CURVED = {
    "waves": lambda level, index: WavyWater((0.0, 0.0, level), (0.05,), ((1.0, 0.5),), n_water=index),
    "sphere": lambda level, index: SphericalWater((0.0, 0.0, level), 5000.0, n_water=index),
    "any": lambda level, index: Veiled(WavyWater((0.0, 0.0, level), (0.05,), ((1.0, 0.5),), n_water=index)),
    "cubic": lambda level, index: BicubicWater(
        (-30.0, -30.0), 1.0, torch.tensor(raster(BicubicWater, 1.0, half=30.0).heights) + level, n_water=index
    ),
}


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name == "cubic" else name for name in CURVED]
)
def test_transforms_of_torch_reach_level_and_index_of_curved_water(name):
    rays, points = (torch.tensor(v) for v in rays_and_points(np.random.default_rng(1), 2))
    centre = torch.tensor(CENTRE)

    def told(numbers):
        water = CURVED[name](numbers[0], numbers[1])
        return torch.cat([trace(centre, rays, water).water_direction, project(points, centre, water).direction])

    numbers = torch.tensor([0.1, 1.33], dtype=torch.float64)
    forward, reverse = jacfwd(told)(numbers), jacrev(told)(numbers)
    np.testing.assert_allclose(forward, reverse, rtol=1e-11, atol=1e-12)
    step = 1e-5
    for k in range(2):
        shift = step * torch.eye(2, dtype=torch.float64)[k]
        differences = (told(numbers + shift) - told(numbers - shift)) / (2.0 * step)
        np.testing.assert_allclose(reverse[..., k], differences, atol=1e-8)
    rows = torch.stack([numbers, numbers + 0.01])
    np.testing.assert_allclose(vmap(told)(rows), torch.stack([told(row) for row in rows]), atol=1e-13)


FAR = np.array([5e6, -2e6, 1024.0])
AXIS = np.linspace(-64.0, 64.0, 33)
RELIEF = 0.05 * np.sin(AXIS) * np.cos(AXIS[:, None])
ANYWHERE = {
    "plane": lambda o: FlatWater(tuple(o), slope_x=0.01),
    "layers": lambda o: ParallelLayers(tuple(o), (0.0, 0.02, 1.0), (1.0, 1.5, 1.33), (0.01,)),
    "waves": lambda o: WavyWater(tuple(o), (0.02,), ((1.5, 0.3),)),
    "sphere": lambda o: SphericalWater(tuple(o)),
    "triangles": lambda o: HeightFieldWater.from_raster(o[0] + AXIS, o[1] + AXIS, o[2] + RELIEF),
    "cubic pieces": lambda o: BicubicWater((o[0] - 64.0, o[1] - 64.0), 4.0, o[2] + RELIEF),
    "height and normal": lambda o: Veiled(WavyWater(tuple(o), (0.02,), ((1.5, 0.3),))),
}


@pytest.mark.parametrize("name", list(ANYWHERE))
def test_paths_5000_km_from_the_origin_are_those_at_the_origin(rng, name):
    """To the last bit through planes; elsewhere to the rounding of coordinates, 1e-9 m, over 30 m."""
    rays, points = rays_and_points(rng)
    points = np.round(points * 1024.0) / 1024.0  # the sums below are not rounded
    near, far = (ANYWHERE[name](o) for o in (0.0 * FAR, FAR))
    exact = name in ("plane", "layers")
    for here, there in (
        (project(points, CENTRE, near).direction, project(points + FAR, CENTRE + FAR, far).direction),
        *zip(*(_ends_of(trace(c, rays, water)) for c, water in ((CENTRE, near), (CENTRE + FAR, far))), strict=True),
    ):
        assert np.isfinite(here).all()
        np.testing.assert_allclose(there, here, rtol=0.0, atol=0.0 if exact else 5e-9)


def _ends_of(path):
    layered = isinstance(path, LayeredPath)
    return (path.direction, path.lengths[0]) if layered else (path.water_direction, path.air_length)
