"""Cauchy prior on second differences of the heights: smooth beds with steps and edges."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse

from fields.solver.tile import Tile


@dataclass(frozen=True)
class SecondDifferences:
    """Second differences of the heights of a tile, M of N heights: along rows, columns and across both.

    They are zero on a plane, however steep.
    """

    matrix: sparse.csr_matrix  # (M, N) sparse: of heights
    transposed: sparse.csr_matrix  # (N, M) sparse
    squared: sparse.csr_matrix  # (N, M) sparse: squares of the entries

    @cached_property
    def _touching(self) -> sparse.csr_matrix:
        """Averaging operator (N, M) over the second differences that each height takes part in."""
        touching = self.squared.copy()
        counts = np.diff(touching.indptr)
        touching.data = np.repeat(1.0 / np.maximum(counts, 1), counts).astype(np.float32)
        return touching

    def mean_at_heights(self, values: np.ndarray) -> np.ndarray:
        """Mean (N,) of values (M,) over the second differences of each height; 0 where there are none."""
        return self._touching @ values

    def gradient(self, stiffness: np.ndarray, heights: np.ndarray) -> np.ndarray:
        """Gradient (N,) of half the sum of stiffness (M,) times squared second differences."""
        return self.transposed @ (stiffness * (self.matrix @ heights))


def second_differences_of(tile: Tile) -> SecondDifferences:
    """Second-difference operator of the pixels of a tile."""
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
    matrix = sparse.vstack(parts).tocsr()
    transposed = matrix.T.tocsr()
    squared = transposed.copy()
    squared.data *= squared.data
    return SecondDifferences(matrix, transposed, squared)


def stiffness_of(differences: np.ndarray, roughness: float) -> np.ndarray:
    """Weights (M,) [1/m^2] of squared second differences (M,) [m] of a Cauchy prior of scale ``roughness`` [m].

    Its heavy tails keep steps and edges: a second difference much above the roughness costs hardly more when it grows.
    """
    return (1.0 / (roughness**2 + differences * differences)).astype(np.float32)
