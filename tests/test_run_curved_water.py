"""Points found under a plane of water that is none: where they are under the true surface, against exact rays."""

import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from fields.sweep.bed import BedPoints
from refract import FlatWater, PinholeCamera
from refract.curved import WavyWater
from survey.run.points import bed_per_level, through_surface
from survey.run.tile_job import TileJob
from survey.water.surface import Departure

N = 1.333
LENGTH = 20.0
# Falls by 20 cm from a crest to the trough 10 m on.
TRUE = WavyWater((0.0, 0.0, 0.0), [0.1], [(2.0 * math.pi / LENGTH, 0.0)], [0.5 * math.pi], n_water=N)
PLANE = FlatWater((0.0, 0.0, 0.02), n_water=N)
DOWN = np.diag([1.0, -1.0, -1.0])


def cameras(**changes):
    made = [
        PinholeCamera(np.array([x, y, 22.0]), DOWN, 900.0, 900.0, 256.0, 192.0, 512, 384)
        for x in range(-9, 10, 3)
        for y in (-3, 0, 3)
    ]
    return [replace(camera, **changes) for camera in made]


def departure():
    xy = np.stack(np.meshgrid(np.arange(-25.0, 26.0), np.arange(-12.0, 13.0)), axis=-1).reshape(-1, 2)
    over = TRUE.height(*xy.T) - PLANE.height(*xy.T)
    return Departure(np.column_stack([xy, over]), np.full(len(xy), 0.002))


def intersected(views, points, true=TRUE, plane=PLANE):
    """Where rays bent at a plane meet of the pixels that show points (N, 3) through the true surface."""
    normal, right = np.zeros((len(points), 3, 3)), np.zeros((len(points), 3))
    for camera in views:
        pixels = camera.project(points, true)
        seen = camera.sees(pixels)
        path = camera.paths(pixels[seen], plane)
        along, through = (
            np.where(path.wet[:, None], wet, dry)
            for wet, dry in ((path.water_direction, path.air_direction), (path.crossing, path.origin))
        )
        across = np.eye(3) - along[:, :, None] * along[:, None]
        normal[seen] += across
        right[seen] += np.einsum("nij,nj->ni", across, through)
    return np.linalg.solve(normal, right[..., None])[..., 0]


def bed_of(xyz):
    none = np.zeros(len(xyz), dtype=np.float32)
    depth = (PLANE.height(*xyz[:, :2].T) - xyz[:, 2]).astype(np.float32)
    return BedPoints(
        xyz,
        np.zeros((len(xyz), 3), dtype=np.uint8),
        none + 0.005,
        none.astype(np.uint8),
        depth,
        none + 0.2,
        depth > 0.0,
    )


def drawn(rng, count=400):
    return rng.uniform((-6.0, -2.0, -2.5), (6.0, 2.0, -0.5), (count, 3))


@pytest.mark.parametrize("tide", [0.0, 0.15])
def test_points_go_where_rays_through_the_true_surface_meet(rng, tide):
    views, points = cameras(tide=tide), drawn(rng)
    bed = bed_of(intersected(views, points))
    assert np.std(bed.xyz[:, 2] - points[:, 2]) > 0.008
    moved = through_surface(bed, views, PLANE, departure())
    off = moved.xyz - points
    # What a raster of 1 m leaves of the curvature.
    assert np.abs(off[:, 2]).max() < 3e-3
    assert np.abs(off[:, :2]).max() < 1e-3
    np.testing.assert_allclose(moved.depth, TRUE.height(*moved.xyz[:, :2].T) - moved.xyz[:, 2], atol=2e-3)


def test_what_the_surface_does_not_know_is_in_the_std(rng):
    bed, known = bed_of(intersected(cameras(), drawn(rng))), departure()
    vague = Departure(known.points, np.full(len(known.points), 0.05))
    _, of_surface = vague.at(bed.xyz[:, :2])
    moved = through_surface(bed, cameras(), PLANE, vague)
    # Interpolated between nodes, where points lie: a quarter less than in between.
    np.testing.assert_allclose(moved.std, np.hypot(0.005, bed_per_level(0.2, N) * of_surface), rtol=0.3)
    assert moved.std.min() > 1.3 * 0.005


def test_dry_points_stay(rng):
    points = rng.uniform((-6.0, -2.0, 0.3), (6.0, 2.0, 0.5), (50, 3))
    moved = through_surface(bed_of(points), cameras(), PLANE, departure())
    np.testing.assert_allclose(moved.xyz, points, atol=1e-6)
    assert not moved.wet.any()


def test_no_points_stay_none():
    assert len(through_surface(BedPoints.empty(), cameras(), PLANE, departure())) == 0


def test_a_level_moves_the_bed_by_what_rays_say():
    level = 0.01
    for incidence in (1e-6, math.radians(20.0), math.radians(35.0)):
        in_water = math.asin(math.sin(incidence) / N)
        aside = level * (math.tan(incidence) - math.tan(in_water))
        assert level * bed_per_level(np.array(incidence), N) == pytest.approx(aside / math.tan(in_water), rel=1e-6)
    assert bed_per_level(np.array(0.0), N) == pytest.approx(N - 1.0)


def test_heights_over_the_plane_of_a_tile_become_those_over_that_of_the_survey(rng):
    own = FlatWater((0.0, 0.0, -0.08), n_water=N, slope_x=-0.02, slope_y=0.004)
    camera, (column, row) = cameras()[0], rng.integers((50, 50), (450, 330), (20, 2)).T
    heights = rng.uniform(-2.0, 0.3, 20).astype(np.float32)

    def over_whole(water: FlatWater) -> np.ndarray:
        survey = SimpleNamespace(water=water, views=[SimpleNamespace(camera=camera)])
        whole = SimpleNamespace(survey=SimpleNamespace(water=PLANE))
        tile = SimpleNamespace(survey=survey, survey_job=whole)
        return TileJob.over_whole(tile, 0, row, column, heights)

    xyz = camera.paths(np.column_stack([column, row]) + 0.5, own).at_height(heights.astype(float), own)
    # Half a float32 of metres.
    np.testing.assert_allclose(over_whole(own), xyz[:, 2] - 0.02, atol=2e-7)
    assert over_whole(PLANE) is heights
