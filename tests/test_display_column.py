"""Finite values of a column in portions: those of the whole."""

from __future__ import annotations

import numpy as np
import pytest

from geo import shapes
from geo.shapes import ComputedColumn
from survey.display.plan_grid import finite, median


@pytest.fixture(autouse=True)
def small_portions(monkeypatch):
    monkeypatch.setattr(shapes, "_PORTION", 37)


@pytest.mark.parametrize("kind", [np.float16, np.float32, np.float64, np.uint8, np.int64])
@pytest.mark.parametrize("count", [1, 2, 36, 37, 500])
def test_the_finite_values_are_those_of_the_whole(rng, kind, count):
    is_whole = np.dtype(kind).kind != "f"
    values = rng.integers(0, 200, count) if is_whole else rng.normal(0.0, 3.0, count)
    values, mask = values.astype(kind), rng.random(count) < 0.9
    if not is_whole and count > 36:
        values[::7], values[3], values[5], values[10] = np.nan, -np.inf, 0.0, -0.0
    known = np.isfinite(values)
    np.testing.assert_array_equal(finite(values), values[known])
    np.testing.assert_array_equal(finite(values, mask), values[known & mask])
    assert finite(values).dtype in (np.float32, np.float64)
    # float32 has steps of 6e-8.
    assert median(values) == pytest.approx(np.median(values[known].astype(np.float64)), rel=1e-7)


def test_a_column_may_hold_nothing_that_counts():
    assert not len(finite(np.array([np.nan, np.inf], dtype=np.float32)))
    assert np.isnan(median(np.zeros(0, dtype=np.float32)))


def test_a_computed_column_has_the_values_of_its_function(rng):
    east, north = rng.normal(size=(2, 200))
    column_of_both, both = ComputedColumn(np.hypot, east, north), np.hypot(east, north)
    assert len(column_of_both) == 200
    np.testing.assert_array_equal(column_of_both[[7, 150]], both[[7, 150]])
    np.testing.assert_array_equal(finite(column_of_both, east > 0.0), both[east > 0.0])
    assert median(column_of_both, east > 0.0) == np.median(both[east > 0.0])
