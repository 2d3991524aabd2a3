"""Surfaces of the water in single photographs, and displacements by them."""

import dataclasses

import numpy as np
import pytest
from scipy import ndimage

from fields.waves.surfaces import CellAdjustment, Displacements, Posterior, find_surfaces
from fields.waves.waves import Crossings, Waves
from refract import kernels
from refract.curved import WavyWater
from survey.run.stage_sweep import load_rough_water, save_rough_water

INDEX, SPACING, NOISE_M = 1.34, 0.25, 0.004
# Amplitude [m], wave vector [rad/m].
SEA = ((0.006, 1.5, 0.6), (0.0045, -0.8, 1.9), (0.0025, 3.3, 2.6))


def sea(seed: int, amplitude: float = 1.0) -> WavyWater:
    """The waves of one moment."""
    phases = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, len(SEA))
    vectors = [each[1:] for each in SEA]
    return WavyWater((0.0, 0.0, 0.0), [amplitude * each[0] for each in SEA], vectors, phases, n_water=INDEX)


def displaced(water: WavyWater, rays: Crossings) -> np.ndarray:
    """Displacements (2, N) by a surface."""
    place = rays.place.astype(np.float64)
    return rays.displacement(water.height(*place), np.array(water.gradient(*place)))


def some_points(count: int = 200) -> np.ndarray:
    random = np.random.default_rng(1)
    return np.stack([*random.uniform(-8.0, 8.0, (2, count)), -random.uniform(0.5, 5.0, count)]).astype(np.float32)


def place_on_bed(centre: np.ndarray, crossing: np.ndarray, depth: np.ndarray, water: WavyWater) -> np.ndarray:
    """Where a ray of a camera (3,) toward crossings (2, N) of still water meets depths (N,) through the waves."""
    ray = np.vstack([crossing, np.zeros(len(depth))]) - centre[:, None]
    ray /= np.linalg.norm(ray, axis=0)
    along = -centre[2] / ray[2]
    for _ in range(20):
        x, y, z = centre[:, None] + along * ray
        along = along - (z - water.height(x, y)) / ray[2]
    x, y, z = centre[:, None] + along * ray
    bent = np.array(kernels.bend(tuple(ray), tuple(water.normal(x, y)), 1.0, INDEX))
    return np.stack([x, y]) + bent[:2] / bent[2] * (-depth - z)


@pytest.mark.parametrize("amplitude", [0.01, 0.1])
def test_a_point_is_seen_displaced_as_the_bent_ray_says(amplitude):
    centre, points, water = np.array([3.0, -5.0, 30.0]), some_points(), sea(2, amplitude)
    found = displaced(water, Crossings.of(centre, points, INDEX))
    shown_at = points.astype(np.float64)
    shown_at[:2] += found
    crossing = Crossings.of(centre, shown_at, INDEX).place
    missed = place_on_bed(centre, crossing, -shown_at[2], water) - points[:2]
    # What is left is of second order: of slopes of 0.01, a hundredth.
    assert np.sqrt(np.mean(missed**2)) < 0.3 * amplitude * np.sqrt(np.mean(found**2))


def test_displacements_are_linear_in_the_gradient():
    rays = Crossings.of(np.array([3.0, -5.0, 30.0]), some_points(), INDEX)
    for axis in (0, 1):
        gradient = np.zeros((2, 200))
        gradient[axis] = 0.01
        expected = 0.01 * rays.by_gradient[:, axis]
        assert rays.displacement(np.zeros(200), gradient) == pytest.approx(expected, rel=1e-5, abs=1e-9)


def test_dry_ground_is_not_displaced():
    points = some_points()
    points[2] *= -1.0
    rays = Crossings.of(np.array([3.0, -5.0, 30.0]), points, INDEX)
    assert not rays.displacement(np.ones(200), np.ones((2, 200))).any()


def cells_of(found: Displacements) -> CellAdjustment:
    return CellAdjustment(found.cell, found.parallax, found.information)


@dataclasses.dataclass(frozen=True)
class Drawn:
    """Displacements of a sea that is known."""

    displacements: Displacements
    true: np.ndarray  # (M, 2) [m]
    found: Posterior

    def height_errors(self, displacement: np.ndarray) -> np.ndarray:
        """Errors (C,) [m] of heights by displacements."""
        cells = cells_of(self.displacements)
        return cells.free(cells.weighted(displacement.astype(np.float32)))[:, 0]


@pytest.fixture(scope="module", params=[6, 16])
def drawn(request) -> Drawn:
    random, side = np.random.default_rng(3), SPACING * (np.arange(40) + 0.5)
    points = np.stack([each.ravel() for each in np.meshgrid(side, side, [-3.0], indexing="ij")]).astype(np.float32)
    parts = []
    for view in range(request.param):
        centre = np.array([*random.uniform(-4.0, 14.0, 2), 40.0])
        rays, raised = (Crossings.of(centre, points + lift, INDEX) for lift in (0.0, np.float32([[0.0], [0.0], [0.1]])))
        parallax = (raised.place - rays.place) * 0.0 + (points[:2] - rays.place) / 3.0
        parts.append((rays.place, rays.by_gradient, rays.by_height, parallax, displaced(sea(view), rays)))
    place, by_gradient, by_height, parallax, true = (np.concatenate([p[k] for p in parts], axis=-1) for k in range(5))
    count = points.shape[1]
    noise = NOISE_M * random.standard_normal(true.T.shape)
    displacements = Displacements(
        np.tile(np.arange(count), request.param),
        np.repeat(np.arange(request.param), count),
        place.T,
        np.moveaxis(by_gradient, -1, 0),
        by_height.T,
        parallax.T,
        true.T + noise,
        # Twice as much as the noise leaves: how much it is has to be found.
        np.broadcast_to(2.0 / NOISE_M**2 * np.eye(2), (len(noise), 2, 2)),
    )
    return Drawn(displacements, true.T, find_surfaces(displacements, request.param, SPACING))


def test_surfaces_are_recovered(drawn):
    cells = cells_of(drawn.displacements)
    one, other = (
        cells.left(cells.weighted(each.astype(np.float32))) for each in (drawn.found.displacement, drawn.true)
    )
    assert np.corrcoef(one.ravel(), other.ravel())[0, 1] > 0.95


def test_heights_lose_most_of_the_waves(drawn):
    before, after = (drawn.height_errors(drawn.true - found).std() for found in (0.0, drawn.found.displacement))
    assert after < 0.4 * before


def test_the_posterior_says_how_wrong_heights_are(drawn):
    actual = drawn.height_errors(drawn.found.displacement - drawn.true).std()
    assert drawn.found.errors[..., 0].std() == pytest.approx(actual, rel=0.25)


def test_the_error_of_all_heights_alike_is_told_apart(drawn):
    assert np.abs(drawn.found.errors[..., 0].mean(axis=1)).max() < 1e-6
    shared = drawn.height_errors(drawn.found.displacement - drawn.true).mean()
    # Of three draws.
    assert 0.0 < abs(shared) < 4.0 * drawn.found.common_std


def test_the_noise_is_found(drawn):
    assert drawn.found.noise == pytest.approx(2.0, rel=0.1)


def test_rasters_have_the_displacements_of_the_solved_surfaces(drawn):
    centres = np.zeros((1 + drawn.displacements.view.max(), 3))
    random = np.random.default_rng(3)
    for centre in centres:
        centre[:] = *random.uniform(-4.0, 14.0, 2), 40.0
    waves = Waves.still(centres, np.zeros(len(centres)), INDEX).with_surfaces(
        drawn.found, np.zeros((2, 2, 2), dtype=np.float32), np.zeros(2), 3.0
    )
    first = drawn.displacements.view == 0
    side = SPACING * (np.arange(40) + 0.5)
    points = np.stack([each.ravel() for each in np.meshgrid(side, side, [-3.0], indexing="ij")]).astype(np.float32)
    rays = waves.crossings(0, points)
    found = rays.displacement(*waves.surface(0, rays.place)).T
    expected = drawn.found.displacement[first]
    assert np.sqrt(np.mean((found - expected) ** 2)) < 0.02 * expected.std()


def test_surfaces_displace_as_rays_that_they_bend():
    # Waves that fit the raster of their coefficients, of slopes of 0.1.
    count, spacing, amplitude, turns = 48, 0.5, 0.05, np.array([[6, 3], [-2, 7]])
    vectors, centre, points = 2.0 * np.pi * turns / (count * spacing), np.array([3.0, -5.0, 30.0]), some_points()
    water = WavyWater((-12.0, -12.0, 0.0), [amplitude, amplitude], vectors, n_water=INDEX)
    nodes = spacing * np.arange(count) - 12.0
    values = water.height(*np.meshgrid(nodes, nodes, indexing="ij"))
    coefficients = ndimage.spline_filter(values, order=3, mode="grid-wrap").astype(np.float32)[None]
    still = Waves.still(centre[None], np.zeros(1), INDEX)
    waves = dataclasses.replace(still, corner=np.full((1, 2), -12.0), spacing=spacing, coefficients=coefficients)
    found = waves.displacement(0, points)
    shown_at = points.astype(np.float64)
    shown_at[:2] += found
    missed = place_on_bed(centre, Crossings.of(centre, shown_at, INDEX).place, -shown_at[2], water) - points[:2]
    assert np.sqrt(np.mean(missed**2)) < 0.02 * np.sqrt(np.mean(found**2))


def test_surfaces_are_read_as_they_were_written(drawn, tmp_path):
    assert load_rough_water(tmp_path) == (None, 0.0)
    num, random = drawn.found.grid.num_views, np.random.default_rng(3)
    still = Waves.still(np.array([[*random.uniform(-4.0, 14.0, 2), 40.0] for _ in range(num)]), np.zeros(num), INDEX)
    waves = still.with_surfaces(drawn.found, np.zeros((2, 2, 2), dtype=np.float32), np.zeros(2), 3.0)
    save_rough_water(tmp_path, waves, 0.7)
    found, moved_px = load_rough_water(tmp_path)
    assert (moved_px, found.deep) == (0.7, 3.0)
    points = np.array([[2.0, 5.0], [3.0, 4.0], [-3.0, -2.0]], dtype=np.float32)
    assert np.array_equal(found.displacement(1, points), waves.displacement(1, points))
    assert waves.displacement(1, points).any()


def test_the_sea_is_described(drawn):
    amplitudes, vectors = np.array([each[0] for each in SEA]), np.array([each[1:] for each in SEA])
    slope = np.sqrt(0.5 * np.sum((amplitudes[:, None] * vectors) ** 2))
    found = drawn.found.sea
    assert found.slope_rms == pytest.approx(slope, rel=0.3)
    assert found.significant_height_m == pytest.approx(4.0 * np.sqrt(0.5 * np.sum(amplitudes**2)), rel=0.3)
    assert found.peak_length_m == pytest.approx(2.0 * np.pi / np.hypot(*vectors[0]), rel=0.3)
