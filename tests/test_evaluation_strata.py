"""Parts of a cloud, by hand."""

from __future__ import annotations

import math

import numpy as np

from evaluation import by_band, by_depth, spatial_blocks


def test_wet_and_dry_are_split_five_centimetres_off_the_shoreline():
    depth = np.array([-1.0, -0.04, 0.04, 0.3, 0.7, 1.0, 45.0, np.nan])
    d = np.array([1.0, 2, 3, 4, 5, 6, 7, 8])
    parts = by_depth(d, depth)
    assert (parts.dry.n_points, parts.dry.mean_m) == (1, 1.0)
    assert (parts.wet.n_points, parts.wet.mean_m) == (4, 5.5)
    bands = [(b.low, b.high, b.distances.n_points) for b in parts.bands]
    assert bands == [(0.0, 0.5, 2), (0.5, 1.0, 1), (1.0, 2.0, 1), (30.0, math.inf, 1)]
    assert by_depth(d[:2], depth[:2]).wet is None


def test_the_lower_limit_of_a_band_belongs_to_it_and_empty_bands_are_left_out():
    d = np.array([1.0, 2.0, 3.0, 4.0])
    bands = by_band(d, np.array([0.0, 5.0, 7.0, np.nan]), (0.0, 5.0, 6.0, 7.0, math.inf))
    assert [(b.low, b.high, b.distances.mean_m) for b in bands] == [
        (0.0, 5.0, 1.0),
        (5.0, 6.0, 2.0),
        (7.0, math.inf, 3.0),
    ]


def test_a_band_has_the_interval_of_its_own_points(rng):
    plan = rng.uniform(0.0, 50.0, (20_000, 2))
    d = np.where(plan[:, 0] < 25.0, 0.01, 0.03) + rng.normal(0.0, 0.001, 20_000)
    shallow, deep = by_band(d, plan[:, 0], (0.0, 25.0, 50.0), spatial_blocks(plan, d))
    assert shallow.distances.mean_ci95_m[0] < 0.01 < shallow.distances.mean_ci95_m[1] < 0.011
    assert deep.distances.mean_ci95_m[0] < 0.03 < deep.distances.mean_ci95_m[1] < 0.031
