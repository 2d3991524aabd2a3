"""Statistics of a column in portions: those of numpy over the whole."""

from __future__ import annotations

import numpy as np
import pytest

from geo import columns
from geo.columns import ComputedColumn
from survey.display.column import ColumnStatistics

KINDS = [np.float16, np.float32, np.float64, np.uint8, np.int64]


@pytest.fixture(autouse=True)
def small_portions(monkeypatch):
    monkeypatch.setattr(columns, "_PORTION", 37)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("count", [1, 2, 36, 37, 500])
def test_statistics_are_those_of_the_whole(rng, kind, count):
    is_whole = np.dtype(kind).kind != "f"
    values = rng.integers(0, 200, count) if is_whole else rng.normal(0.0, 3.0, count)
    values = values.astype(kind)
    if not is_whole and count > 36:
        values[::7], values[3], values[5], values[10] = np.nan, -np.inf, 0.0, -0.0
    finite = values[np.isfinite(values)].astype(np.float64)
    found = ColumnStatistics(values)
    assert found.size == len(finite)
    assert (found.least, found.greatest) == (finite.min(), finite.max())
    assert found.mean == pytest.approx(finite.mean(), rel=1e-12, abs=1e-12)
    # float32 has steps of 6e-8.
    assert found.median == pytest.approx(np.median(finite), rel=1e-7)
    shares = (0.0, 0.002, 0.05, 0.5, 0.95, 0.998, 1.0)
    np.testing.assert_allclose(found.quantiles(*shares), np.quantile(finite, shares), rtol=1e-6, atol=1e-6)
    edges = np.linspace(finite.min(), finite.max() + 1.0, 12)
    np.testing.assert_array_equal(found.histogram(edges), np.histogram(finite, edges)[0])


def test_some_of_the_values_may_count_and_all_may_be_scaled(rng):
    values, among = rng.normal(size=200).astype(np.float32), rng.random(200) < 0.3
    found, some = ColumnStatistics(values, among, 1e3), 1e3 * values[among].astype(np.float64)
    assert found.size == among.sum()
    assert found.median == pytest.approx(np.median(some))
    assert found.mean == pytest.approx(some.mean())
    assert (found.least, found.greatest) == pytest.approx((some.min(), some.max()))
    edges = np.linspace(-3e3, 3e3, 7)
    np.testing.assert_array_equal(found.histogram(edges), np.histogram(some, edges)[0])


def test_a_column_may_hold_nothing_that_counts():
    assert ColumnStatistics(np.array([np.nan, np.inf], dtype=np.float32)).size == 0
    assert ColumnStatistics(np.zeros(0, dtype=np.float32)).size == 0


def test_a_computed_column_has_the_statistics_of_its_function(rng):
    east, north = rng.normal(size=(2, 200))
    column_of_both, both = ComputedColumn(np.hypot, east, north), np.hypot(east, north)
    assert len(column_of_both) == 200
    np.testing.assert_array_equal(column_of_both[[7, 150]], both[[7, 150]])
    found = ColumnStatistics(column_of_both, east > 0.0)
    assert found.size == (east > 0.0).sum()
    assert found.median == np.median(both[east > 0.0])
    assert found.greatest == both[east > 0.0].max()
