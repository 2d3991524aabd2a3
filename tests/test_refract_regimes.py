"""Every ray is counted: what becomes of rays and points that have no answer, in all libraries."""

from __future__ import annotations

import math

import numpy as np
import pytest
from surface_rays import LIBRARIES, SINGLE, rows, vectors

from refract import FlatWater, Regime, bend, bend_regime, project, regime_counts, trace

WATER = FlatWater((0.0, 0.0, 2.0), n_water=1.34)
CENTRE = np.array([1.0, -2.0, 30.0])
NAN, INF = math.nan, math.inf

# One ray per row, and what becomes of it.
RAYS = [
    ([0.6, 0.0, -0.8], Regime.BENT),
    ([0.0, 0.0, -1.0], Regime.BENT),
    ([0.6, 0.0, 0.8], Regime.STRAIGHT),
    ([0.0, 1.0, 0.0], Regime.PARALLEL),
    ([NAN, 0.0, -1.0], Regime.INVALID),
    ([0.0, 0.0, -INF], Regime.INVALID),
]
POINTS = [
    ([4.0, 1.0, -3.0], Regime.BENT),
    ([1.0, -2.0, -3.0], Regime.BENT),
    ([4.0, 1.0, 2.0], Regime.STRAIGHT),
    ([4.0, 1.0, 12.0], Regime.STRAIGHT),
    ([1.0, -2.0, 30.0], Regime.INVALID),
    ([4.0, NAN, -3.0], Regime.INVALID),
    ([4.0, 1.0, -INF], Regime.INVALID),
]


@pytest.mark.parametrize("library", LIBRARIES)
def test_each_traced_ray_is_told_what_became_of_it(library):
    path = trace(CENTRE, vectors(library, [row for row, _ in RAYS]), WATER)
    np.testing.assert_array_equal(np.asarray(path.regime), [kind for _, kind in RAYS])
    assert path.regime_counts() == {
        "bent": 2, "straight": 1, "parallel": 1, "under_water": 0,
        "reflected": 0, "critical": 0, "unseen": 0, "invalid": 2,
    }  # fmt: skip
    np.testing.assert_array_equal(np.asarray(path.wet), [True, True, False, False, False, False])
    directions, crossings = rows(path.water_direction), rows(path.crossing)
    np.testing.assert_allclose(directions[2:4], [[0.6, 0.0, 0.8], [0.0, 1.0, 0.0]], atol=1e-7)
    np.testing.assert_array_equal(np.isnan(crossings).all(axis=-1), [False, False, True, True, True, True])
    np.testing.assert_array_equal(np.isnan(np.asarray(path.air_length)), [kind == Regime.INVALID for _, kind in RAYS])


@pytest.mark.parametrize("library", LIBRARIES)
def test_each_projected_point_is_told_what_became_of_it(library):
    seen = project(vectors(library, [row for row, _ in POINTS]), CENTRE, WATER)
    np.testing.assert_array_equal(np.asarray(seen.regime), [kind for _, kind in POINTS])
    assert seen.regime_counts()["invalid"] == 3
    np.testing.assert_array_equal(np.isnan(rows(seen.direction)).any(axis=-1), [k == Regime.INVALID for _, k in POINTS])
    np.testing.assert_array_equal(np.asarray(seen.wet)[:5], [True, True, False, False, False])


@pytest.mark.parametrize("library", LIBRARIES)
def test_a_camera_under_water_is_counted_and_looks_straight(library):
    low = np.array([0.0, 0.0, -1.0])
    path = trace(low, vectors(library, [row for row, _ in RAYS]), WATER)
    assert path.regime_counts()["under_water"] == 4
    assert path.regime_counts()["invalid"] == 2
    seen = project(vectors(library, [row for row, _ in POINTS]), low, WATER)
    assert seen.regime_counts()["under_water"] == 5
    way = np.array([point for point, _ in POINTS[:4]]) - low
    length = np.linalg.norm(way, axis=-1)
    # float32: one rounding of the result
    np.testing.assert_allclose(rows(seen.direction)[:4], way / length[:, None], atol=1e-7)
    np.testing.assert_allclose(np.asarray(seen.water_length)[:4], length * [1, 1, 0, 0], rtol=1e-7)
    np.testing.assert_allclose(np.asarray(seen.air_length)[:4], length * [0, 0, 1, 1], rtol=1e-7)


@pytest.mark.parametrize("library", LIBRARIES)
def test_without_water_all_rays_are_straight(library):
    path = trace(CENTRE, vectors(library, [row for row, _ in RAYS]), None)
    assert path.regime_counts()["straight"] == 4
    assert path.regime_counts()["invalid"] == 2
    seen = project(vectors(library, [row for row, _ in POINTS]), CENTRE, None)
    assert seen.regime_counts()["straight"] == 4
    assert not np.asarray(seen.wet).any()
    np.testing.assert_array_equal(rows(seen.crossing)[:5], [point for point, _ in POINTS[:5]])


@pytest.mark.parametrize("library", LIBRARIES)
def test_rays_out_of_the_water_are_counted_by_what_stops_them(library):
    critical = math.asin(1.0 / 1.34)
    angles = [0.0, 0.5, critical - 1e-9, critical + 1e-4, math.pi / 2, math.pi, NAN]
    up = [([math.sin(a), 0.0, math.cos(a) if a != math.pi / 2 else 0.0], a) for a in angles]
    arguments = vectors(library, [row for row, _ in up]), np.array([0.0, 0.0, -1.0])
    found = np.asarray(bend_regime(*arguments, n_from=1.34, n_to=1.0))
    expected = [Regime.BENT, Regime.BENT, Regime.CRITICAL, Regime.REFLECTED, Regime.PARALLEL, Regime.REFLECTED]
    if library in SINGLE:  # 1e-9 rad are less than a unit in the last place
        found[2] = Regime.CRITICAL
    np.testing.assert_array_equal(found, [*expected, Regime.INVALID])
    bent = rows(bend(*arguments, n_from=1.34, n_to=1.0))
    np.testing.assert_array_equal(np.isnan(bent).any(axis=-1)[3:], True)


def test_counts_cover_every_ray_once():
    codes = np.array([[0, 0, 3], [7, 7, 7]])
    found = regime_counts(codes)
    assert sum(found.values()) == codes.size
    assert (found["bent"], found["under_water"], found["invalid"]) == (2, 1, 3)


def test_a_ray_that_would_pass_behind_the_camera_never_meets_the_water():
    # Not even when the plane is 45 degrees steep and the ray runs along it, up to its rounding.
    water = FlatWater((0.0, 0.0, 0.0), n_water=1.34, slope_x=1.0)
    half = math.sqrt(0.5)
    path = trace(np.array([0.0, 0.0, 5.0]), np.array([[half, 0.0, half], [-half, 0.0, half]]), water)
    assert path.regime_counts()["parallel"] == 1
    assert path.regime_counts()["straight"] == 1
