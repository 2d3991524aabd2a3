"""The median by one partition is that of numpy."""

from __future__ import annotations

import numpy as np
import pytest

from fields.sweep.images import median


@pytest.mark.parametrize("shape", [(1,), (2,), (7, 9), (8, 9)])
@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_it_is_that_of_numpy_and_the_values_stay_in_their_order(shape, kind, rng):
    values = rng.normal(size=shape).astype(kind)
    before = values.copy()
    assert median(values) == float(np.median(before))
    np.testing.assert_array_equal(values, before)


@pytest.mark.parametrize("count", [4, 5])
def test_it_is_nan_where_a_value_is(count, rng):
    values = rng.normal(size=count)
    values[1] = np.nan
    assert np.isnan(median(values))


def test_no_values_are_refused():
    with pytest.raises(ValueError, match="no values"):
        median(np.empty((0, 3)))
