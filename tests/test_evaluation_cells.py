"""Points binned into the cells of a raster."""

from __future__ import annotations

import numpy as np

from evaluation.bootstrap import cell_counts, cell_means, cell_numbers

SHAPE = (2, 3)
# Column and row: two in the first cell, one in the last, one on the outer edge, one before it, one without a place.
AT = np.array([[0.0, 0.0], [0.9, 0.9], [2.5, 1.5], [3.0, 0.0], [-0.1, 1.0], [np.nan, 0.0]])


def test_cells_are_numbered_row_by_row_and_what_lies_beyond_has_none():
    assert cell_numbers(AT, SHAPE).tolist() == [0, 0, 5, -1, -1, -1]


def test_points_beyond_the_raster_count_nowhere():
    assert cell_counts(cell_numbers(AT, SHAPE), SHAPE).tolist() == [[2, 0, 0], [0, 0, 1]]


def test_a_mean_leaves_out_values_that_are_nan_and_is_nan_where_nothing_is_left():
    values = np.array([1.0, np.nan, np.nan, 7.0, 7.0, 7.0])
    np.testing.assert_array_equal(
        cell_means(cell_numbers(AT, SHAPE), values, SHAPE), [[1.0, *[np.nan] * 2], [np.nan] * 3]
    )
