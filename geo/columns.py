"""Columns of many points, in portions: in little memory, however many there are."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

# Rows that are worked on at a time, unless a caller has its own number.
_PORTION = 250_000


def portions(count: int, at_once: int | None = None) -> Iterator[slice]:
    """Slices that cover ``count`` rows, of at most ``at_once`` rows each."""
    step = _PORTION if at_once is None else at_once
    return (slice(first, first + step) for first in range(0, count, step))


class ComputedColumn:
    """A column (N,) that is a function of others, computed for the rows that are asked for.

    Parameters
    ----------
    function : callable
        Of the same rows of all columns.
    columns : (N, ...), one at least
    """

    def __init__(self, function: Callable[..., np.ndarray], *columns: np.ndarray):
        self._function, self._columns = function, columns

    def __len__(self) -> int:
        return len(self._columns[0])

    def __getitem__(self, rows) -> np.ndarray:
        """Values of some rows: a slice, or their numbers."""
        return self._function(*(np.asarray(column[rows]) for column in self._columns))
