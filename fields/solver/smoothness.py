"""What is known of a bed before it is seen: it bends little from pixel to pixel, except where it does."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from fields.solver.tile import Tile


@dataclass(frozen=True)
class Bends:
    """Second differences of the heights of a tile, M of N heights: along rows, columns and across both.

    A plane bends nowhere, however steep it is.

    Attributes
    ----------
    of_heights : (M, N) sparse
    transposed : (N, M) sparse
    squared : (N, M) sparse
        Squares of the entries.
    """

    of_heights: sparse.csr_matrix
    transposed: sparse.csr_matrix
    squared: sparse.csr_matrix

    @cached_property
    def _touching(self) -> sparse.csr_matrix:
        """Which bends (N, M) each height takes part in, with equal shares of one."""
        touching = self.squared.copy()
        counts = np.diff(touching.indptr)
        touching.data = np.repeat(1.0 / np.maximum(counts, 1), counts).astype(np.float32)
        return touching

    def mean_about(self, values: np.ndarray) -> np.ndarray:
        """Mean (N,) of values (M,) over the bends that each height takes part in; 0 where there are none."""
        return self._touching @ values

    def pull(self, stiffness: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Gradient (N,) of half the sum of stiffness (M,) times squared bends."""
        return self.transposed @ (stiffness * (self.of_heights @ heights))


def bends_of(tile: Tile) -> Bends:
    """All second differences between the pixels of a tile."""
    number, parts = tile.number, []
    along, cross = np.array([1.0, -2.0, 1.0]), np.sqrt(2.0) * np.array([1.0, -1.0, -1.0, 1.0])
    for members, factors in (
        ((number[:, :-2], number[:, 1:-1], number[:, 2:]), along),
        ((number[:-2], number[1:-1], number[2:]), along),
        ((number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]), cross),
    ):
        whole = np.flatnonzero(np.logical_and.reduce([each >= 0 for each in members]))
        chosen = np.stack([each.ravel()[whole] for each in members], axis=-1)
        rows, size = len(chosen), len(factors)
        values = np.tile(factors, rows).astype(np.float32)
        parts.append(sparse.csr_matrix((values, chosen.ravel(), np.arange(rows + 1) * size), shape=(rows, len(tile))))
    of_heights = sparse.vstack(parts).tocsr()
    transposed = of_heights.T.tocsr()
    squared = transposed.copy()
    squared.data *= squared.data
    return Bends(of_heights, transposed, squared)


def stiffness_of(bends: np.ndarray, roughness: float) -> np.ndarray:
    """Weights (M,) [1/m^2] of squared bends (M,) [m]: those of Cauchy's law of scale ``roughness`` [m].

    Its long tails let steps and edges stand: a bend much above the roughness costs hardly more when it grows.
    """
    return (1.0 / (roughness**2 + bends * bends)).astype(np.float32)
