"""The steps of the simulation study's protocol, as the benchmark of its tables takes them."""

import numpy as np
import pytest
from study import near_their_planes, study_cloud, trimmed

from evaluation import distance_statistics

FLAT_MM = 2.0
MIDDLE = np.zeros(2)


def bed_with_a_deck(rng: np.random.Generator) -> np.ndarray:
    """A flat bed of 12 m x 12 m whose middle stands 2.5 m higher, as a wreck, in points every 10 cm."""
    xy = np.stack(np.meshgrid(*[np.arange(-6.0, 6.0, 0.1)] * 2), axis=-1).reshape(-1, 2)
    z = np.where(np.abs(xy).max(axis=1) < 1.0, 2.5, 0.0) + rng.normal(0.0, 1e-3 * FLAT_MM, len(xy))
    return np.column_stack([xy, z])


def test_a_wreck_on_a_flat_bed_passes_the_filter_of_noise():
    points = bed_with_a_deck(np.random.default_rng(0))
    deck = points[:, 2] > 1.0
    kept = near_their_planes(points)
    # One plane through all points would leave nothing of the deck.
    assert (kept[:, 2] > 1.0).sum() > 0.75 * deck.sum()
    assert len(kept) > 0.75 * len(points)


def test_points_off_the_plane_of_their_neighbours_are_noise():
    points = bed_with_a_deck(np.random.default_rng(1))
    noise = np.column_stack([np.linspace(-5.0, 5.0, 9), np.full(9, 4.0), np.full(9, 0.1)])
    kept = near_their_planes(np.concatenate([points, noise]))
    assert not (np.abs(kept[:, 2] - 0.1) < 0.02).any()


def test_the_clouds_of_fields_alone_are_cleaned():
    points = bed_with_a_deck(np.random.default_rng(2))
    away = np.concatenate([points, [[0.0, 3.0, 9.0]]])
    assert study_cloud(away, MIDDLE, wet=False, field=False)[:, 2].max() == 9.0
    assert study_cloud(away, MIDDLE, wet=False, field=True)[:, 2].max() < 3.0
    assert len(study_cloud(points, MIDDLE, wet=True, field=False)) == len(points)


def test_outliers_are_told_before_the_cloud_is_thinned():
    # A clump of a thousand points within a cell is no outlier of them all, and one if one of it is left.
    points = bed_with_a_deck(np.random.default_rng(3))
    clump = np.array([0.02, 3.02, 9.02]) + np.random.default_rng(4).uniform(0.0, 0.01, (1000, 3))
    assert study_cloud(np.concatenate([points, clump]), MIDDLE, wet=False, field=True)[:, 2].max() > 9.0


def test_the_inner_part_by_size_and_by_quantiles_of_the_studys_distances():
    distances = np.random.default_rng(5).normal(1.092, 0.346, 1_000_000)
    by_size = distance_statistics(distances)
    assert (by_size.mean_inner90_m, by_size.std_inner90_m) == pytest.approx((1.025, 0.293), abs=2e-3)
    assert trimmed(distances) == pytest.approx((1.092, 0.273), abs=2e-3)
