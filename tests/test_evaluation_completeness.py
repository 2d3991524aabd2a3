"""Completeness: samples spread by area, and a tolerance that is strict."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.stats import chi2

from evaluation import c2m, distance_to_cloud, f_score, is_reached, sample_mesh

# A random test that is right fails once in 10^6 seeds; this one has a fixed seed and passes for good.
CHANCE = 1e-6
PLANE = np.array([[0.0, 0, 0], [4, 0, 0], [4, 1, 0], [0, 1, 0]])
PLANE_FACES = np.array([[0, 1, 2], [0, 2, 3]])


def _fits(counts: np.ndarray, shares: np.ndarray) -> bool:
    expected = counts.sum() * shares
    return chi2.sf(((counts - expected) ** 2 / expected).sum(), len(counts) - 1) > CHANCE


def test_samples_are_uniform_by_area_across_triangles_of_very_different_size(rng):
    vertices = rng.normal(size=(60, 3)) * [10.0, 1.0, 1.0]
    vertices[30:] *= 0.2
    faces = np.arange(60).reshape(20, 3)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    assert areas.max() > 50 * areas.min()
    samples, sampled = sample_mesh(vertices, faces, 100_000)
    normals = np.cross(b - a, c - a) / (2 * areas[:, None])
    # The planes of random triangles are all different: the plane says which triangle a sample is of.
    off_plane = np.abs(np.einsum("nfd,fd->nf", samples[::5, None] - a, normals))
    face = off_plane.argmin(axis=1)
    assert off_plane.min(axis=1).max() < 1e-12
    np.testing.assert_array_equal(sampled[::5], face)
    assert _fits(np.bincount(face, minlength=20), areas / areas.sum())


def test_samples_are_uniform_within_a_triangle():
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    samples, _ = sample_mesh(corners, np.array([[0, 1, 2]]), 200_000)
    assert (samples[:, :2] >= 0).all()
    assert (samples[:, :2].sum(axis=1) <= 1 + 1e-12).all()
    # Eight strips by eight: whole cells below the diagonal, halves on it.
    cell = (samples[:, :2] * 8).astype(int).clip(max=7)
    counts = np.bincount(cell[:, 0] * 8 + cell[:, 1], minlength=64).reshape(8, 8)
    i, j = np.indices((8, 8))
    area = np.where(i + j < 7, 2.0, np.where(i + j == 7, 1.0, 0.0))
    assert counts[area == 0].sum() == 0
    assert _fits(counts[area > 0], area[area > 0] / area.sum())


def test_one_seed_gives_one_set_of_samples_and_another_seed_another():
    first, again, other = (sample_mesh(PLANE, PLANE_FACES, 1000, seed=s)[0] for s in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert (first[:, 0] != other[:, 0]).all()


def test_triangles_without_area_get_no_sample_and_a_mesh_of_them_is_refused():
    faces = np.array([[0, 0, 1], [0, 1, 2], [2, 2, 2], [0, 2, 3], [1, 1, 3]])
    samples, _ = sample_mesh(PLANE, faces, 10_000)
    assert _fits(np.bincount((samples[:, 0] < 4 * samples[:, 1]).astype(int)), np.array([0.5, 0.5]))
    with pytest.raises(ValueError, match="no area to sample"):
        sample_mesh(PLANE, faces[[0, 2]], 10)


def test_the_tolerance_is_strict():
    samples = np.zeros((3, 3))
    samples[:, 0] = [0.25, np.nextafter(0.25, 0), np.nextafter(0.25, 1)]
    assert is_reached(samples, np.zeros((1, 3)), tolerance_m=0.25).tolist() == [False, True, False]
    # 0.2 squared rounds up: in squares the comparison would call this one closer than itself.
    assert not is_reached(np.array([[0.2, 0, 0]]), np.zeros((1, 3)), tolerance_m=0.2).any()


def test_a_plane_covered_for_a_quarter_is_complete_for_a_quarter_plus_the_tolerance():
    """A dense cloud over x < 1 of 4 m reaches x < 1.2: a share of 0.3."""
    x, y = np.meshgrid(np.arange(0.0, 1.0 + 1e-9, 0.01), np.arange(-0.3, 1.3, 0.01))
    cloud = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    samples, _ = sample_mesh(PLANE, PLANE_FACES, 200_000)
    share = is_reached(samples, cloud, tolerance_m=0.2).mean()
    # Binomial, six sigma; between two rows of points, 1 cm apart, the reach falls short by 0.06 mm.
    assert abs(share - 0.3) < 6 * np.sqrt(0.3 * 0.7 / 200_000) + 0.0001


def test_distances_to_a_cloud_agree_with_all_pairs(rng):
    points, cloud = rng.normal(size=(300, 3)), rng.normal(size=(200, 3))
    pairs = np.linalg.norm(points[:, None] - cloud, axis=2)
    distances, numbers = distance_to_cloud(points, cloud)
    np.testing.assert_allclose(distances, pairs.min(axis=1), rtol=1e-14)
    np.testing.assert_array_equal(numbers, pairs.argmin(axis=1))
    bounded, bounded_numbers = distance_to_cloud(points, cloud, within_m=0.5)
    far = pairs.min(axis=1) > 0.5
    assert far.any()
    np.testing.assert_array_equal(np.isinf(bounded), far)
    np.testing.assert_array_equal(bounded_numbers == -1, far)


def test_an_empty_cloud_reaches_nothing_and_points_that_are_not_finite_are_nowhere():
    samples = np.array([[0.0, 0, 0], [np.nan, 0, 0]])
    assert not is_reached(samples, np.empty((0, 3)), tolerance_m=1.0).any()
    cloud = np.array([[np.nan, 0, 0], [0, 0, 0.5]])
    distances, numbers = distance_to_cloud(samples, cloud)
    np.testing.assert_array_equal(distances, [0.5, np.nan])
    assert numbers.tolist() == [1, -1]


def test_a_cloud_of_equal_points_is_searched_as_one(rng, monkeypatch):
    cloud = np.tile([[1.0, 2.0, 3.0]], (5_000, 1))
    samples = rng.normal(size=(2_000, 3))
    searched = []

    def tree_of(points, **options):
        searched.append(len(points))
        return cKDTree(points, **options)

    # Equal points cannot be split: every query would look at all of them.
    monkeypatch.setattr(c2m, "cKDTree", tree_of)
    reached = is_reached(samples, cloud, tolerance_m=3.0)
    assert searched == [1]
    np.testing.assert_array_equal(reached, np.linalg.norm(samples - cloud[0], axis=1) < 3.0)


def test_the_f_score_is_the_harmonic_mean_and_zero_where_nothing_fits():
    assert [f_score(0.5, 1.0), f_score(0.0, 0.0), f_score(1.0, 0.0)] == pytest.approx([2 / 3, 0.0, 0.0], rel=1e-15)
