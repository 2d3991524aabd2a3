"""Normal equations of a block at a state, with the points eliminated by the Schur complement.

With V the normal matrix of a point, W that of the points and the parameters, U that of the parameters and ``V = L L'``,
the parameters have ``U - W' V^-1 W = U - C' C`` with the coupling ``C = L^-1 W``.

M points, N observations (a point in a photograph), P parameters (`survey.adjust.block.state`)
r      residual, measured minus predicted pixel (N, 2)
X, B   derivatives of the prediction by its point (N, 2, 3) and by the parameters (2 N, P), sparse
w      weight of an observation (N,) [1/px^2]
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import block_array, bsr_array, coo_array, csr_array, diags_array

from survey.adjust.block.normal_matrix import NormalMatrix
from survey.adjust.block.prediction import linearise, linearise_by_points
from survey.adjust.block.problem import Problem, huber_weights
from survey.adjust.block.state import NUM_POSE, NUM_SHIFT, Layout, State
from survey.photos.poses import TiePoints

# Points whose height has more than so many times the median standard deviation are of uncertain height.
_WEAK = 3.0
# Parameters besides poses up to which their columns are taken as dense.
_FEW = 100
# Keeps the elimination finite for a point that its rays hardly determine. It holds points where they are, and with them
# the scale of a block: 1e-9 constrains it as strongly as positions of 0.2 m.
_DAMPING = 1e-13


@dataclass(frozen=True)
class Coupling:
    """Mixed matrix C (3 M, P) of points and parameters, with the roots of the points' own matrices before it.

    With these, the elimination is one product.
    """

    shared: np.ndarray | csr_array  # (3 M, Q): of all parameters but poses; dense where they are few
    poses: bsr_array  # (3 M, 6 V): each pose is coupled with a point as a whole

    def times(self, step: np.ndarray) -> np.ndarray:
        """``C step`` (3 M,) of a step (P,)."""
        num = self.shared.shape[1]
        return self.shared @ step[:num] + self.poses @ step[num:]

    def transposed_times(self, values: np.ndarray) -> np.ndarray:
        """``C' values`` (P, ...) of values (3 M, ...)."""
        return np.concatenate([self.shared.T @ values, self.poses.T @ values])

    def of_point(self, number: int) -> np.ndarray:
        """The rows (3, P) of a point."""
        rows = slice(3 * number, 3 * number + 3)
        unit = np.zeros((self.poses.shape[0], 3))
        unit[rows] = np.eye(3)
        return self.transposed_times(unit).T


@dataclass(frozen=True)
class System:
    """The normal equations at a state, points eliminated."""

    # normal, right_side (P, P), (P,): of the parameters with the points following, priors included
    normal: NormalMatrix
    right_side: np.ndarray
    point_root: np.ndarray  # (M, 3, 3): inverse Cholesky factors L^-1 of the points' normal matrices
    point_right_side: np.ndarray  # (M, 3): L^-1 times the right sides of the points
    coupling: Coupling  # L^-1 times the normal matrix of points and parameters

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
        return -self.coupling.transposed_times((up * used[:, None]).reshape(-1)) / used.sum()

    def point_steps(self, step: np.ndarray) -> np.ndarray:
        """Steps (M, 3) [m] of the points that go with a step of the parameters (P,)."""
        left = self.point_right_side - self.coupling.times(step).reshape(-1, 3)
        return np.einsum("mij,mi->mj", self.point_root, left)


def huber_system(
    problem: Problem, state: State, std_px: np.ndarray, variance_factor: np.ndarray | float = 1.0
) -> System:
    """The normal equations at a state with Huber weights, for standard deviations (kinds,) [px] of the observations."""
    linear = LinearisedObservations.at(problem, state)
    return _system(problem, state, linear.weighted(huber_weights(problem, linear.residuals, std_px) / variance_factor))


def system_with(problem: Problem, state: State, weights: np.ndarray) -> System:
    """The normal equations at a state, for weights (N,) [1/px^2] of the observations."""
    return _system(problem, state, LinearisedObservations.at(problem, state).weighted(weights))


@dataclass
class LinearisedObservations:
    residuals: np.ndarray  # (N, 2)
    by_point: np.ndarray  # (N, 2, 3): X
    design: np.ndarray | None  # (N, 2, K): B, see `Prediction.by_parameters`; None where the parameters are held

    @classmethod
    def at(cls, problem: Problem, state: State) -> LinearisedObservations:
        of_block = problem.layout, state, problem.ties, problem.rise_design, problem.rows
        if problem.holds_parameters:
            pixels, by_point = linearise_by_points(*of_block)
            return cls(problem.ties.pixel - pixels, by_point, None)
        linear = linearise(*of_block)
        return cls(problem.ties.pixel - linear.pixels, linear.by_point, linear.by_parameters)

    def weighted(self, weights: np.ndarray) -> LinearisedObservations:
        """Times the roots of their weights; those of weight 0 are zero, and ``by_point`` is (2, 3, N)."""
        unusable, roots = np.flatnonzero(weights == 0.0), np.sqrt(weights)
        self.residuals[unusable], self.by_point[unusable] = 0.0, 0.0
        if self.design is not None:
            self.design[unusable] = 0.0
            self.design *= roots[:, None, None]
        by_point = np.moveaxis(self.by_point, 0, -1) * roots
        return LinearisedObservations(self.residuals * roots[:, None], by_point, self.design)


def _system(problem: Problem, state: State, linear: LinearisedObservations) -> System:
    priors = problem.priors
    planes = None if priors.planes is None else priors.planes.of_points(state.points, state.shift)
    own, right = _of_points(problem, state, linear, planes)
    damping = (_DAMPING * np.trace(own, axis1=1, axis2=2)[:, None, None] + 1e-300) * np.eye(3)
    point_root = _inverse_triangular(np.linalg.cholesky(own + damping))
    point_right_side = np.einsum("mij,mj->mi", point_root, right)
    precision = np.where(np.isfinite(priors.std), priors.std, np.inf) ** -2.0
    if linear.design is None:
        fixed = Coupling(csr_array((point_right_side.size, len(precision))), bsr_array((point_right_side.size, 0)))
        normal, none = NormalMatrix.of(csr_array(diags_array(precision))), np.zeros(len(precision))
        return System(normal, none, point_root, point_right_side, fixed)
    coupling = _coupling(problem, linear, point_root, planes)
    by_view, gradients = _of_parameters(problem, linear)
    deviation = priors.deviation(problem.layout, state)
    gradient = np.bincount(problem.layout.columns.ravel(), gradients.ravel(), len(precision))
    gradient -= coupling.transposed_times(point_right_side.ravel()) + precision * deviation
    of_shift = np.zeros((problem.layout.first_pose,) * 2)
    if planes is not None:
        shift, (on_plane, to_plane) = problem.layout.shift, planes
        of_shift[shift, shift] = on_plane.sum(axis=0)
        gradient[shift] -= to_plane.sum(axis=0)
    matrix = _reduced(problem.layout, by_view, of_shift, coupling, is_dense=problem.order is None)
    normal = NormalMatrix.of(matrix, problem.order).with_precision(precision)
    if len(priors.signs):
        normal = normal.with_rows(priors.rows, priors.signs)
        gradient -= priors.rows.T @ (priors.signs * (priors.rows @ deviation))
    return System(normal, gradient, point_root, point_right_side, coupling)


def _of_points(
    problem: Problem, state: State, linear: LinearisedObservations, planes: tuple[np.ndarray, np.ndarray] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrices (M, 3, 3) and right sides (M, 3) of the points alone; ``planes`` as of `Planes.of_points`."""
    precision = problem.priors.point_std**-2.0
    own = _sum(problem.ties, np.einsum("ain,ajn->ijn", linear.by_point, linear.by_point))
    own[:, range(3), range(3)] += precision
    right = _sum(problem.ties, np.einsum("ain,na->in", linear.by_point, linear.residuals))
    right = right - precision * np.nan_to_num(state.points - problem.priors.state.points)
    return (own, right) if planes is None else (own + planes[0], right + planes[1])


def _of_parameters(problem: Problem, linear: LinearisedObservations) -> tuple[np.ndarray, np.ndarray]:
    """Normal matrices ``B' B`` (V, K, K) and gradients (V, K) of the parameters of each photograph."""
    size = problem.layout.columns.shape
    assert linear.design is not None
    normal, gradient = np.empty((*size, size[1])), np.empty(size)
    for number, rows in enumerate(problem.rows_of_views):
        part = linear.design[rows].reshape(-1, size[1])
        normal[number], gradient[number] = part.T @ part, linear.residuals[rows].ravel() @ part
    return normal, gradient


def _reduced(
    layout: Layout, by_view: np.ndarray, shared: np.ndarray, coupling: Coupling, *, is_dense: bool
) -> np.ndarray | csr_array:
    """``U - C' C`` (P, P), U that of the parameters of each photograph (V, K, K) and of all but poses (Q, Q)."""
    num, num_shared = len(layout.lens_of), layout.first_pose
    columns, views = layout.columns[:, :-NUM_POSE], np.arange(num)
    mixed = np.zeros((num, NUM_POSE, num_shared))
    np.add.at(shared, (columns[:, :, None], columns[:, None, :]), by_view[:, :-NUM_POSE, :-NUM_POSE])
    mixed[views[:, None], :, columns] = by_view[:, :-NUM_POSE, -NUM_POSE:]
    poses = (
        bsr_array((by_view[:, -NUM_POSE:, -NUM_POSE:], views, np.arange(num + 1))) - coupling.poses.T @ coupling.poses
    )
    shared = shared - coupling.shared.T @ coupling.shared
    mixed = mixed.reshape(-1, num_shared) - coupling.poses.T @ coupling.shared
    if is_dense:
        return np.block([[shared, mixed.T], [mixed, poses.toarray()]])
    return csr_array(block_array([[coo_array(shared), coo_array(mixed.T)], [coo_array(mixed), poses]]))


def _coupling(
    problem: Problem,
    linear: LinearisedObservations,
    point_root: np.ndarray,
    planes: tuple[np.ndarray, np.ndarray] | None,
) -> Coupling:
    """The coupling of points and parameters; ``planes`` as of `Planes.of_points`."""
    ties, layout, num = problem.ties, problem.layout, 3 * len(problem.ties)
    assert linear.design is not None
    roots = np.take(np.moveaxis(point_root, 0, -1), ties.point, axis=-1)
    by_point = np.einsum("ijn,ajn->ian", roots, linear.by_point)
    values = np.ascontiguousarray(np.moveaxis(by_point, -1, 0)) @ linear.design
    starts = np.searchsorted(ties.point, np.arange(len(ties) + 1))
    poses = bsr_array((values[:, :, -NUM_POSE:], ties.view, starts), shape=(num, len(layout) - layout.first_pose))
    alike = problem.alike
    data = (alike.summed @ values.reshape(len(values), -1)).reshape(len(alike.point), 3, -1)[:, :, :-NUM_POSE]
    rows = np.broadcast_to(3 * alike.point[:, None, None] + np.arange(3)[:, None], data.shape)
    columns = np.broadcast_to(alike.columns[:, None], data.shape)
    shape = num, layout.first_pose
    if layout.first_pose <= _FEW:
        shared = np.bincount((rows * shape[1] + columns).ravel(), data.ravel(), num * shape[1]).reshape(shape)
    else:
        shared = csr_array((data.ravel(), (rows.ravel(), columns.ravel())), shape=shape)
    if planes is not None:
        by_shift, first = -(point_root @ planes[0]).reshape(-1, NUM_SHIFT), layout.shift.start
        where = first + np.tile(np.arange(NUM_SHIFT), num)
        shared = shared + csr_array((by_shift.ravel(), where, NUM_SHIFT * np.arange(num + 1)), shape=shared.shape)
    return Coupling(shared, poses)


def _sum(ties: TiePoints, values: np.ndarray) -> np.ndarray:
    """Sums (M, ...) of values (..., N) over the observations of each point."""
    first = np.searchsorted(ties.point, np.arange(len(ties)))
    return np.moveaxis(np.add.reduceat(values, first, axis=-1), -1, 0)


def _inverse_triangular(lower: np.ndarray) -> np.ndarray:
    """Inverses (M, 3, 3) of lower triangular matrices, at a tenth of what `numpy.linalg.inv` takes."""
    found = np.zeros_like(lower)
    found[:, range(3), range(3)] = 1.0 / lower[:, range(3), range(3)]
    (xx, yy, zz), yx, zy = found[:, range(3), range(3)].T, lower[:, 1, 0], lower[:, 2, 1]
    found[:, 1, 0] = -yx * xx * yy
    found[:, 2, 1] = -zy * yy * zz
    found[:, 2, 0] = -(lower[:, 2, 0] * xx + zy * found[:, 1, 0]) * zz
    return found
