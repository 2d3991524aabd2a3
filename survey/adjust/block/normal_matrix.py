"""Normal matrices of bundle adjustment with the points eliminated, and their Cholesky factors.

Photographs are coupled where they show points in common, so that the matrix of a large block is sparse: breadth-first
levels of the graph of photographs make it block tridiagonal, with a border of the parameters that all photographs share
(water, lenses). That is factored in dense blocks, and steps and standard deviations take of the inverse only what they
need; covariances of the whole block are dense:

    A. George and J. W. Liu, Computer solution of large sparse positive definite systems, 1981, chapter 4 (level
    structures);  K. Takahashi, J. Fagan, M.-S. Chin, Formation of a sparse bus impedance matrix, PICA 1973 (selected
    inverse).

A small block, or one whose photographs all overlap, is factored as one dense matrix, in as few arrays as that takes.
Parameters have different units: matrices are scaled to ones on their diagonal first.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.linalg.lapack import dpotri
from scipy.sparse import csr_array, diags_array
from scipy.sparse.csgraph import connected_components, dijkstra

# Rows that are copied or scaled at a time, and columns of an inverse that are solved for at a time.
_ROWS = 256
# Block tridiagonal factors take so many times the operations of a dense one, in blocks of the same size: 7/3 b^3 of
# each of P / b blocks in place of P^3 / 3. They are taken where they save half of them.
_BLOCK_OPERATIONS, _SAVED = 7.0, 0.5
# Parameters up to which a dense factor takes a tenth of a second at most.
_SMALL = 1500


@dataclass(frozen=True)
class EliminationOrder:
    """Order in which parameters (P,) are eliminated."""

    # (n,) int64 each: parameters of photographs; a block is coupled with the one before and the one after it alone
    blocks: tuple[np.ndarray, ...]
    shared: np.ndarray  # (Q,) int64: parameters that all photographs share; they come last


def elimination_order(
    point: np.ndarray, view: np.ndarray, photograph: np.ndarray, *, small: int = _SMALL
) -> EliminationOrder | None:
    """Order of elimination of a block; None where its normal matrix is best taken as dense.

    Observations are of points and in photographs of these numbers (N,); ``photograph`` (P,) int64 is that whose
    parameter each one is, -1 of those that all share. Up to ``small`` parameters are dense.
    """
    if len(photograph) <= small:
        return None
    levels = _levels(point, view, int(photograph.max()) + 1)
    blocks = tuple(np.flatnonzero(np.isin(photograph, level)) for level in levels)
    operations = _BLOCK_OPERATIONS * sum(float(len(block)) ** 3 for block in blocks)
    if operations > _SAVED * float(len(photograph)) ** 3:
        return None
    return EliminationOrder(blocks, np.flatnonzero(photograph < 0))


def _levels(point: np.ndarray, view: np.ndarray, num_views: int) -> list[np.ndarray]:
    """Photographs by their distance from one at the end of the graph of those that show points in common."""
    shape = (int(point.max(initial=-1)) + 1, num_views)
    shows = csr_array((np.ones(len(point)), (point, view)), shape=shape)
    graph = csr_array(shows.T @ shows)
    neighbours = np.diff(graph.indptr)
    found: list[np.ndarray] = []
    count, part_of = connected_components(graph, directed=False)
    for part in range(count):
        end = int(np.flatnonzero(part_of == part)[0])
        # Of the farthest from the farthest, the one with the fewest neighbours is close to an end.
        for _ in range(3):
            distance = dijkstra(graph, directed=False, indices=end, unweighted=True)
            distance = np.where(part_of == part, distance, -1.0)
            end = min(np.flatnonzero(distance == distance.max()).tolist(), key=neighbours.__getitem__)
        found += [np.flatnonzero(distance == level) for level in range(int(distance.max()) + 1)]
    return found


@dataclass(frozen=True)
class NormalMatrix:
    """Normal matrix (P, P): a matrix, sparse in a large block, plus ``rows.T @ diag(signs) @ rows`` of joint priors."""

    matrix: csr_array | np.ndarray  # (P, P)
    rows: np.ndarray  # (K, P)
    signs: np.ndarray  # (K,)
    order: EliminationOrder | None = None  # None: the matrix is taken as dense

    def __len__(self) -> int:
        return self.matrix.shape[0]

    @staticmethod
    def of(matrix: csr_array | np.ndarray, order: EliminationOrder | None = None) -> NormalMatrix:
        """A matrix alone."""
        return NormalMatrix(matrix, np.zeros((0, matrix.shape[0])), np.zeros(0), order)

    def with_precision(self, precision: np.ndarray) -> NormalMatrix:
        """The matrix with precisions (P,), inverse variances, added to its diagonal."""
        if isinstance(self.matrix, np.ndarray):
            matrix = self.matrix.copy()
            matrix[np.diag_indices_from(matrix)] += precision
            return replace(self, matrix=matrix)
        return replace(self, matrix=csr_array(self.matrix + diags_array(precision)))

    def with_rows(self, rows: np.ndarray, signs: np.ndarray) -> NormalMatrix:
        """The matrix with further rows (K, P) and signs (K,)."""
        return replace(self, rows=np.vstack([self.rows, rows]), signs=np.append(self.signs, signs))

    def only(self, parameters: np.ndarray) -> NormalMatrix:
        """The normal matrix of some parameters (K,), sorted numbers, with the others held."""
        number = np.full(len(self), -1)
        number[parameters] = np.arange(len(parameters))
        order = None
        if self.order is not None:
            *blocks, shared = (number[each][number[each] >= 0] for each in (*self.order.blocks, self.order.shared))
            order = EliminationOrder(tuple(block for block in blocks if len(block)), shared)
        return NormalMatrix(self.matrix[parameters][:, parameters], self.rows[:, parameters], self.signs, order)

    def between(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """The part (R, C) of the matrix in some rows (R,) and columns (C,)."""
        joint = (self.rows[:, rows] * self.signs[:, None]).T @ self.rows[:, columns]
        return _as_array(self.matrix[rows][:, columns]) + joint

    def dense(self) -> np.ndarray:
        """The matrix as an array (P, P)."""
        # LAPACK takes columns; a conversion of the whole would copy it.
        matrix = np.empty(self.matrix.shape, order="F")
        for first in range(0, len(self), _ROWS):
            matrix[first : first + _ROWS] = _as_array(self.matrix[first : first + _ROWS])
        if len(self.rows):
            matrix += (self.rows * self.signs[:, None]).T @ self.rows
        return matrix

    def diagonal(self) -> np.ndarray:
        """Its diagonal (P,)."""
        return self.matrix.diagonal() + self.signs @ self.rows**2

    def factor(self, damping: float = 0.0) -> DenseFactor | BlockFactor:
        """Its Cholesky factor, with the diagonal of the scaled matrix raised by a damping."""
        return self._factored(damping) if damping else self._factor

    @cached_property
    def _factor(self) -> DenseFactor | BlockFactor:
        return self._factored(0.0)

    def _factored(self, damping: float) -> DenseFactor | BlockFactor:
        if self.order is None:
            return DenseFactor.of(self, damping)
        return BlockFactor.of(self, self.order, damping)

    @cached_property
    def inverse(self) -> np.ndarray:
        """Its inverse (P, P)."""
        return self.factor().inverse()

    def inverse_diagonal(self) -> np.ndarray:
        """Diagonal (P,) of its inverse."""
        return np.diag(self.inverse) if self.order is None else self.factor().inverse_diagonal()


@dataclass(frozen=True)
class DenseFactor:
    """Cholesky factor of a dense matrix; a block of 2,000 photographs would take 1.2 GB for each array."""

    factor: tuple[np.ndarray, bool]  # as `scipy.linalg.cho_factor` has it, of the scaled matrix
    scale: np.ndarray  # (P,)

    @staticmethod
    def of(normal: NormalMatrix, damping: float) -> DenseFactor:
        matrix = normal.dense()
        scale = _scale_of(np.diag(matrix))
        _scale_rows(matrix, scale)
        matrix[np.diag_indices_from(matrix)] += damping
        return DenseFactor(cho_factor(matrix, overwrite_a=True), scale)

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution of right sides (P,) or (P, R)."""
        scale = self.scale if right.ndim == 1 else self.scale[:, None]
        return scale * cho_solve(self.factor, scale * right)

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the matrix."""
        return 2.0 * float(np.log(np.diag(self.factor[0])).sum() - np.log(self.scale).sum())

    def inverse_diagonal(self) -> np.ndarray:
        """Diagonal (P,) of the inverse."""
        return np.diag(self.inverse())

    def inverse(self) -> np.ndarray:
        """The inverse (P, P)."""
        found, _ = dpotri(*self.factor)
        # It has the upper triangle alone.
        for start in range(0, len(found), _ROWS):
            rows, after = slice(start, start + _ROWS), slice(start + _ROWS, None)
            found[after, rows] = found[rows, after].T
            upper = np.triu(found[rows, rows])
            found[rows, rows] = upper + np.triu(upper, 1).T
        _scale_rows(found, self.scale)
        return found


@dataclass(frozen=True)
class BlockFactor:
    """Cholesky factor of a block tridiagonal matrix with a border of shared parameters and of the rows of joint priors.

    With D the blocks on the diagonal, C those below them and E the border, scaled: ``L L' = D - K K'`` with the K
    before, ``K = C L^-T``, ``G = (E - G K' of the block before) L^-T``; the corner F itself becomes ``F - sum G G'``.
    Rows R of joint priors with signs S, ``A + R' S R``, are those of unknowns more, ``[[A, R'], [R, -1 / S]]``.
    """

    order: EliminationOrder
    scale: np.ndarray  # (P,)
    diagonal_factors: list[np.ndarray]  # L of each block, lower triangular
    below: list[np.ndarray]  # K of each block but the last
    border: list[np.ndarray]  # (Q + K, n): G of each block
    corner: np.ndarray  # (Q + K, Q + K): F less the sum
    corner_inverse: np.ndarray

    @staticmethod
    def of(normal: NormalMatrix, order: EliminationOrder, damping: float) -> BlockFactor:
        scale = _scale_of(normal.diagonal())
        sequence = np.concatenate([*order.blocks, order.shared])
        by_scale = diags_array(scale[sequence])
        matrix = csr_array(by_scale @ normal.matrix[sequence][:, sequence] @ by_scale)
        matrix = csr_array(matrix + damping * diags_array(np.ones(len(sequence))))
        ends = np.cumsum([0, *map(len, order.blocks)])
        edge = np.vstack([matrix[ends[-1] :].toarray(), normal.rows[:, sequence] * scale[sequence]])
        corner = np.hstack([edge[:, ends[-1] :], np.zeros((len(edge), len(normal.signs)))])
        num_shared = len(order.shared)
        corner[:num_shared, num_shared:] = corner[num_shared:, :num_shared].T
        corner[num_shared:, num_shared:] = -np.diag(1.0 / normal.signs)
        diagonal_factors: list[np.ndarray] = []
        below: list[np.ndarray] = []
        border: list[np.ndarray] = []
        reach = edge[:, : ends[1]]
        for number, (first, end) in enumerate(pairwise(ends)):
            rows = matrix[first:end]
            own = rows[:, first:end].toarray()
            if number:
                own -= below[-1] @ below[-1].T
                reach = edge[:, first:end] - border[-1] @ below[-1].T
            diagonal_factors.append(cholesky(own, lower=True, overwrite_a=True))
            border.append(_by_transposed(reach, diagonal_factors[-1]))
            corner -= border[-1] @ border[-1].T
            if number < len(order.blocks) - 1:
                coupling = rows[:, end : ends[number + 2]].toarray().T
                below.append(_by_transposed(coupling, diagonal_factors[-1]))
        # The unknowns of joint priors that add are the negative ones, by Sylvester's law of inertia.
        if np.sum(np.linalg.eigvalsh(corner) <= 0.0) != np.sum(normal.signs > 0.0):
            raise np.linalg.LinAlgError("the matrix with its joint priors is not positive definite")
        return BlockFactor(order, scale, diagonal_factors, below, border, corner, np.linalg.inv(corner))

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Solution of right sides (P,) or (P, R)."""
        scaled = self.scale[:, None] * right.reshape(len(right), -1)
        found, num_shared = np.empty(scaled.shape), len(self.order.shared)
        edge = np.zeros((len(self.corner), scaled.shape[1]))
        edge[:num_shared] = scaled[self.order.shared]
        forward: list[np.ndarray] = []
        for number, block in enumerate(self.order.blocks):
            own = scaled[block]
            # Before the first unknown of a right side, as of those of an inverse, there is nothing to solve.
            if number and forward[-1].any():
                own = own - self.below[number - 1] @ forward[-1]
            if own.any():
                own = solve_triangular(self.diagonal_factors[number], own, lower=True, overwrite_b=True)
                edge -= self.border[number] @ own
            forward.append(own)
        edge = self.corner_inverse @ edge
        found[self.order.shared] = edge[:num_shared]
        for number in range(len(self.order.blocks) - 1, -1, -1):
            own = forward[number] - self.border[number].T @ edge
            if number < len(self.below):
                own -= self.below[number].T @ found[self.order.blocks[number + 1]]
            found[self.order.blocks[number]] = solve_triangular(
                self.diagonal_factors[number], own, lower=True, trans="T"
            )
        return (self.scale[:, None] * found).reshape(right.shape)

    def log_determinant(self) -> float:
        """Natural logarithm of the determinant of the matrix, for signs of joint priors of 1 and -1."""
        logs = sum(float(np.log(np.diag(factor)).sum()) for factor in self.diagonal_factors)
        return 2.0 * (logs - float(np.log(self.scale).sum())) + float(np.linalg.slogdet(self.corner)[1])

    def inverse_diagonal(self) -> np.ndarray:
        """Diagonal (P,) of the inverse, by those of its blocks that the factor has (Takahashi)."""
        found, size = np.empty(len(self.scale)), len(self.corner)
        # The inverse over the block after and the border; of the last block that is the corner.
        beyond = self.corner_inverse
        found[self.order.shared] = np.diag(beyond)[: len(self.order.shared)]
        for number in range(len(self.order.blocks) - 1, -1, -1):
            diagonal_factor = self.diagonal_factors[number]
            coupled = [self.border[number]] if number == len(self.below) else [self.below[number], self.border[number]]
            by_factor = solve_triangular(diagonal_factor, np.vstack(coupled).T, lower=True, trans="T").T
            across = beyond @ by_factor
            own = cho_solve((diagonal_factor, True), np.eye(len(diagonal_factor))) + by_factor.T @ across
            found[self.order.blocks[number]] = np.diag(own)
            of_border = -across[len(across) - size :]
            beyond = np.block([[own, of_border.T], [of_border, beyond[len(beyond) - size :, -size:]]])
        return found * self.scale**2

    def inverse(self) -> np.ndarray:
        """The inverse (P, P)."""
        count = len(self.scale)
        found = np.empty((count, count), order="F")
        sequence = np.concatenate([*self.order.blocks, self.order.shared])
        for first in range(0, count, _ROWS):
            columns = sequence[first : first + _ROWS]
            found[:, columns] = self.solve((np.arange(count)[:, None] == columns).astype(np.float64))
        return found


def _by_transposed(matrix: np.ndarray, diagonal_factor: np.ndarray) -> np.ndarray:
    """A matrix (m, n) times the inverse of the transpose of a lower triangular one (n, n)."""
    return solve_triangular(diagonal_factor, matrix.T, lower=True).T


def _as_array(matrix: csr_array | np.ndarray) -> np.ndarray:
    return matrix if isinstance(matrix, np.ndarray) else matrix.toarray()


def _scale_of(diagonal: np.ndarray) -> np.ndarray:
    return 1.0 / np.sqrt(np.maximum(diagonal, 1e-300))


def _scale_rows(matrix: np.ndarray, scale: np.ndarray) -> None:
    """Multiply each entry by the scales of its row and its column."""
    for first in range(0, len(matrix), _ROWS):
        columns = slice(first, first + _ROWS)
        matrix[:, columns] *= np.outer(scale, scale[columns])


def propagated(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Covariance (..., K, K) of functions whose derivatives (..., K, P) are by unknowns of a covariance (P, P)."""
    return jacobian @ covariance @ jacobian.swapaxes(-1, -2)


def propagated_variance(jacobian: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """Variances (..., K) alone, as `propagated`; rounding leaves none below zero."""
    return np.maximum(np.sum((jacobian @ covariance) * jacobian, axis=-1), 0.0)
