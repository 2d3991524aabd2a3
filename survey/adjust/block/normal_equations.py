"""Normal equations of a block at a state, with the points eliminated by the Schur complement.

With V the normal matrix of a point, W that of the points and the parameters, U that of the parameters and ``V = L L'``,
the parameters have ``U - W' V^-1 W = U - C' C`` with the coupling ``C = L^-1 W``.

M points, N observations (a point in a photograph), P parameters (`survey.adjust.block.state`)
r      residual, measured minus predicted pixel (N, 2)
X, B   derivatives of the prediction by its point (N, 2, 3) and by the parameters (2 N, P), sparse
w      weight of an observation (N,) [1/px^2]
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_array, bsr_array, csr_array, diags_array, lil_array

from survey.adjust.block.normal_matrix import NormalMatrix
from survey.adjust.block.prediction import linearise, linearise_by_points
from survey.adjust.block.problem import HUBER, Problem, huber_weights
from survey.adjust.block.state import NUM_POSE, NUM_SHIFT, State
from survey.photos.poses import TiePoints

# Weights give an outlier the curvature of a square, which Huber's loss has not along its residual: where steps gain
# more than they predict, they are taken with the square of this share of that curvature (B. Triggs et al., Bundle
# adjustment - a modern synthesis, 2000, section 4.3).
_CURVATURE = 0.1
# Points whose height has more than so many times the median standard deviation are of uncertain height.
_WEAK = 3.0
# An operation of a sparse product takes as long as so many of a dense one (50 to 80 for 69 to 435 parameters).
_SPARSE_COST = 50.0
# Parameters besides poses up to which their columns are taken as dense.
_FEW = 100
# Keeps the elimination finite for a point that its rays hardly determine. It holds points where they are, and with them
# the scale of a block: 1e-9 constrains it as strongly as positions of 0.2 m.
_DAMPING = 1e-13


@dataclass(frozen=True)
class System:
    """The normal equations at a state, points eliminated."""

    # normal, right_side (P, P), (P,): of the parameters with the points following, priors included
    normal: NormalMatrix
    right_side: np.ndarray
    point_root: np.ndarray  # (M, 3, 3): inverse Cholesky factors L^-1 of the points' normal matrices
    point_right_side: np.ndarray  # (M, 3): L^-1 times the right sides of the points
    coupling: csr_array  # (3 M, P): L^-1 times the normal matrix of points and parameters

    def predicted_decrease(self, step: np.ndarray) -> float:
        """Predicted decrease of the sum of squares by a step of parameters and points (linear model)."""
        return float(self.right_side @ step + np.sum(self.point_right_side**2))

    def decrement(self) -> float:
        """Predicted decrease of the sum of squares by the undamped step: the Newton decrement."""
        return self.predicted_decrease(self.normal.factor().solve(self.right_side))

    def heights_by_parameters(self) -> np.ndarray:
        """Derivative (P,) of the mean height of the points by the parameters, without those of uncertain height."""
        up = self.point_root[:, :, 2]
        std = np.linalg.norm(up, axis=1)
        # One point whose rays are nearly parallel would outweigh all others.
        used = std <= _WEAK * np.median(std)
        return -(self.coupling.T @ (up * used[:, None]).reshape(-1)) / used.sum()

    def point_steps(self, step: np.ndarray) -> np.ndarray:
        """Steps (M, 3) [m] of the points that go with a step of the parameters (P,)."""
        left = self.point_right_side - (self.coupling @ step).reshape(-1, 3)
        return np.einsum("mij,mi->mj", self.point_root, left)


def system_at(problem: Problem, state: State, std_px: np.ndarray) -> System:
    """The normal equations at a state, for standard deviations (kinds,) [px] of the observations."""
    return huber_system(problem, state, std_px, np.ones(len(problem.kind)))


def system_with(problem: Problem, state: State, weights: np.ndarray) -> System:
    """The normal equations at a state, for weights (N,) [1/px^2] of the observations."""
    return _weighted_system(problem, state, lambda _residuals: weights)


def huber_system(
    problem: Problem, state: State, std_px: np.ndarray, variance_factor: np.ndarray, *, reduces_curvature: bool = False
) -> System:
    """The normal equations with Huber weights.

    ``reduces_curvature`` takes outliers with a share of the curvature that their weights have along the residual.
    """

    def weights_of(residuals: np.ndarray) -> np.ndarray:
        return huber_weights(problem, residuals, std_px) / variance_factor

    def outliers(residuals: np.ndarray) -> np.ndarray:
        return np.linalg.norm(residuals, axis=1) > HUBER * std_px[problem.kind]

    return _weighted_system(problem, state, weights_of, outliers if reduces_curvature else None)


def _weighted_system(
    problem: Problem,
    state: State,
    weights_of: Callable[[np.ndarray], np.ndarray],
    outliers: Callable[[np.ndarray], np.ndarray] | None = None,
) -> System:
    """The normal equations.

    Parameters
    ----------
    weights_of : callable
        Takes residuals (N, 2) [px] to weights (N,) [1/px^2].
    outliers : callable, optional
        Takes them to those whose curvature along the residual is reduced, (N,) bool.
    """
    linear, priors = _linearised(problem, state, weights_of, outliers), problem.priors
    planes = None if priors.planes is None else priors.planes.of_points(state.points, state.shift)
    own, right = _of_points(problem, state, linear, planes)
    point_root = np.linalg.inv(np.linalg.cholesky(_damped(own)))
    point_right_side = np.einsum("mij,mj->mi", point_root, right)
    precision = np.where(np.isfinite(priors.std), priors.std, np.inf) ** -2.0
    if linear.design is None:
        fixed = csr_array((point_right_side.size, len(precision)))
        return System(
            NormalMatrix.of(diags_array(precision)), np.zeros(len(precision)), point_root, point_right_side, fixed
        )
    coupling = _coupling(problem, linear.weighted, linear.design, point_root, planes)
    own_normal = _of_parameters(linear.design, linear.weights, problem.ties.view)
    normal = own_normal - eliminated(coupling, problem.layout.first_pose) + diags_array(precision)
    deviation = priors.deviation(problem.layout, state)
    gradient = linear.design.T @ (linear.weights[:, None] * linear.residuals).ravel()
    gradient = gradient - coupling.T @ point_right_side.ravel() - precision * deviation
    if planes is not None:
        shift, (on_plane, to_plane) = problem.layout.shift, planes
        normal = normal + _in_block(on_plane.sum(axis=0), shift, len(precision))
        gradient[shift] -= to_plane.sum(axis=0)
    found = NormalMatrix.of(normal, problem.order)
    if priors.rows is not None and priors.signs is not None:
        found = found.with_rows(priors.rows, priors.signs)
        gradient -= priors.rows.T @ (priors.signs * (priors.rows @ deviation))
    return System(found, gradient, point_root, point_right_side, coupling)


@dataclass(frozen=True)
class LinearisedObservations:
    """Observations linearised at a state, with their weights; those of weight 0 have no derivatives."""

    residuals: np.ndarray  # (N, 2) [px]
    weights: np.ndarray  # (N,) [1/px^2]
    by_point: np.ndarray  # (N, 2, 3): X
    weighted: np.ndarray  # (N, 2, 3): w X
    design: csr_array | None  # (2 N, P): B; None where the parameters are held


def _linearised(
    problem: Problem,
    state: State,
    weights_of: Callable[[np.ndarray], np.ndarray],
    outliers: Callable[[np.ndarray], np.ndarray] | None,
) -> LinearisedObservations:
    """The observations at a state."""
    of_block = problem.layout, state, problem.ties, problem.rise_design, problem.rows
    design = None
    if problem.holds_parameters:
        pixels, by_point = linearise_by_points(*of_block)
    else:
        linear = linearise(*of_block)
        pixels, by_point, design = linear.pixels, linear.by_point, linear.by_parameters
    residuals = problem.ties.pixel - pixels
    weights = weights_of(residuals)
    usable = weights > 0.0
    residuals = np.where(usable[:, None], residuals, 0.0)
    by_point = np.where(usable[:, None, None], by_point, 0.0)
    if design is not None and not usable.all():
        design = _only_rows(design, usable)
    if outliers is not None:
        is_outlier = usable & outliers(residuals)
        along = residuals / np.maximum(np.linalg.norm(residuals, axis=1, keepdims=True), 1e-300)
        reduced = np.eye(2) - (1.0 - _CURVATURE) * is_outlier[:, None, None] * along[:, :, None] * along[:, None, :]
        # The gradient stays as it is.
        residuals = np.where(is_outlier[:, None], residuals / _CURVATURE, residuals)
        by_point = reduced @ by_point
        if design is not None:
            values = reduced @ design.data.reshape(len(residuals), 2, -1)
            design = csr_array((values.ravel(), design.indices, design.indptr), shape=design.shape)
    return LinearisedObservations(residuals, weights, by_point, by_point * weights[:, None, None], design)


def _of_points(
    problem: Problem, state: State, linear: LinearisedObservations, planes: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrices (M, 3, 3) and right sides (M, 3) of the points alone; ``planes`` as of `Planes.of_points`."""
    precision = problem.priors.point_std**-2.0
    own = _sum(problem.ties, np.einsum("nai,naj->nij", linear.weighted, linear.by_point))
    own[:, range(3), range(3)] += precision
    right = _sum(problem.ties, np.einsum("nai,na->ni", linear.weighted, linear.residuals))
    right = right - precision * np.nan_to_num(state.points - problem.priors.state.points)
    return (own, right) if planes is None else (own + planes[0], right + planes[1])


def _of_parameters(design: csr_array, weights: np.ndarray, view: np.ndarray) -> csr_array:
    """Normal matrix ``U = B' w B`` (P, P); all observations of a photograph (N,) depend on the same parameters."""
    order = np.argsort(view, kind="stable")
    _, starts = np.unique(view[order], return_index=True)
    roots = design.data.reshape(len(view), 2, -1)[order] * np.sqrt(weights[order])[:, None, None]
    parts = (part.reshape(-1, part.shape[-1]) for part in np.split(roots, starts[1:]))
    blocks = np.stack([part.T @ part for part in parts])
    columns = design.indices.reshape(len(view), 2, -1)[order[starts], 0]
    rows = np.repeat(columns, columns.shape[1], axis=1).ravel()
    return csr_array((blocks.ravel(), (rows, np.tile(columns, columns.shape[1]).ravel())), shape=(design.shape[1],) * 2)


def eliminated(coupling: csr_array, first_pose: int) -> csr_array:
    """``C' C`` (P, P) of a coupling (3 M, P) whose columns from ``first_pose`` on are those of poses.

    By dense products where these are faster, and of poses by blocks: each of them is coupled with a point as a whole.
    """
    num_rows, num_columns = coupling.shape
    operations = np.sum(np.diff(coupling.indptr).astype(np.float64) ** 2)
    if num_rows * float(num_columns) ** 2 <= _SPARSE_COST * operations:
        dense = coupling.toarray()
        return csr_array(dense.T @ dense)
    others, of_poses = coupling[:, :first_pose], coupling[:, first_pose:]
    if first_pose <= _FEW:
        others = others.toarray()
    mixed = csr_array(of_poses.T @ others)
    blocks = bsr_array(of_poses, blocksize=(3, NUM_POSE))
    return csr_array(block_array([[csr_array(others.T @ others), mixed.T], [mixed, blocks.T @ blocks]]))


def _coupling(
    problem: Problem,
    weighted: np.ndarray,
    design: csr_array,
    point_root: np.ndarray,
    planes: tuple[np.ndarray, np.ndarray] | None,
) -> csr_array:
    """Mixed matrix (3 M, P) of points and parameters, with the root of the points' own matrices as left factor.

    With that factor, the elimination is one product.
    """
    ties = problem.ties
    rooted = np.einsum("nij,naj->nia", point_root[ties.point], weighted)
    starts = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    left = bsr_array((rooted, np.arange(len(ties.view)), starts), shape=(3 * len(ties), 2 * len(ties.view)))
    coupling = csr_array(left.tocsr() @ design)
    if planes is None:
        return coupling
    return coupling + _in_columns(
        -(point_root @ planes[0]).reshape(-1, NUM_SHIFT), problem.layout.shift, coupling.shape
    )


def _only_rows(design: csr_array, keep: np.ndarray) -> csr_array:
    """A sparse matrix (2 N, P) with rows of zeros for the observations that are not kept, (N,) bool."""
    values = design.data.reshape(2 * len(keep), -1)
    values = np.where(np.repeat(keep, 2)[:, None], np.nan_to_num(values), 0.0)
    return csr_array((values.ravel(), design.indices, design.indptr), shape=design.shape)


def _in_columns(values: np.ndarray, columns: slice, shape: tuple[int, int]) -> csr_array:
    """Values (rows, K) in K of the columns of a sparse matrix of zeros."""
    rows, count = values.shape
    where = np.tile(np.arange(columns.start, columns.stop), rows)
    return csr_array((values.ravel(), where, count * np.arange(rows + 1)), shape=shape)


def _in_block(values: np.ndarray, at: slice, size: int) -> csr_array:
    """Values (K, K) on the diagonal of a sparse matrix of zeros, (size, size)."""
    found = lil_array((size, size))
    found[at, at] = values
    return csr_array(found)


def _sum(ties: TiePoints, values: np.ndarray) -> np.ndarray:
    """Sums over the observations of each point, (M, ...)."""
    first = np.searchsorted(ties.point, np.arange(len(ties)))
    return np.add.reduceat(values, first, axis=0)


def _damped(normal: np.ndarray) -> np.ndarray:
    """Matrices (M, 3, 3), damped enough to be inverted."""
    scale = np.trace(normal, axis1=1, axis2=2)[:, None, None]
    return normal + (_DAMPING * scale + 1e-300) * np.eye(3)
