"""The water with poses and lens free within their errors: a bundle adjustment from the solution that holds them.

Poses and lens have errors, whose effect on the pixels partly resembles that of different water. So each photograph gets
an error of position and direction of its own, and each camera one field of displacements over the image, a polynomial
of degree 3, which includes errors of focal length, principal point and k1 and affine and decentring terms. Besides, a
rough bed hides its hollows from oblique views and looks different from each side, so that it appears to rise a little,
depending on the direction of view. All have zero mean and an assumed standard deviation. The photographs determine most
of them; the rest remains in the covariance of the water.

    e    the errors, P water parameters first; B their derivatives (2 N, P + E), sparse
    H    normal matrix, points eliminated, with the prior Q on its diagonal
    G    score of each point, B' w r (M, P + E)

The covariance is ``H^-1 (G'G + Q) H^-1``: the part by G'G is that of the measurements with those in one square of the
ground as a cluster, the part by each block of Q that of poses, lens and prior.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import block_diag, csr_array, hstack
from scipy.spatial.transform import Rotation

from refract import FlatWater, PinholeCamera, crossing_point
from survey.adjust.least_squares import Adjusted, robust_weights
from survey.adjust.projection import by_parameters, by_point, pixels_of
from survey.photos.tie_points import TiePoints

# Half a step of central differences, in m and rad: 2e-3 and 0.2 px, over which a projection is straight to 1e-6.
_STEP = 1e-4
_DEGREE = 3
# Rounds of renewing the weights from the residuals with poses and lens free; they have converged after two.
_ROUNDS = 3


@dataclass(frozen=True)
class Errors:
    """Standard deviations of the freed parameters: per axis of a position [m] and direction [rad], of lens and bed.

    Attributes
    ----------
    lens_px : [px]
        Of the coefficient of each orthonormal polynomial, in x and in y: the root mean square over the image of the
        displacement by that polynomial alone.
    bed_m : [m]
        By how much higher the bed appears at 45 degrees off the vertical, under water.
    cell_m : [m]
        Points nearer to each other than this share relief and texture, so that their errors are correlated.
    """

    position_m: float
    direction_rad: float
    lens_px: float
    bed_m: float
    cell_m: float


@dataclass(frozen=True)
class Freed:
    """Water with poses and lens free.

    Attributes
    ----------
    parameters : (P,)
    measured, pose, lens, bed : (P, P)
        The covariance, by its source; that of the prior of the water is in the first.
    """

    parameters: np.ndarray
    measured: np.ndarray
    pose: np.ndarray
    lens: np.ndarray
    bed: np.ndarray

    @property
    def covariance(self) -> np.ndarray:
        """All of it, (P, P)."""
        return self.measured + self.pose + self.lens + self.bed


def free_errors(
    cameras: Sequence[PinholeCamera],
    ties: TiePoints,
    solved: Adjusted,
    water_of: Callable[[np.ndarray], FlatWater],
    centre: np.ndarray,
    prior_std: np.ndarray,
    errors: Errors,
) -> Freed:
    """The whole adjustment from a solution of `adjust`: linear, as the freed errors are small, with weights renewed.

    Parameters
    ----------
    cameras, ties, water_of : as for `adjust`
    solved : Adjusted
    centre, prior_std : (P,)
        Prior of the parameters of the water.
    errors : Errors
    """
    water, count = water_of(solved.parameters), len(solved.parameters)
    jx = by_point(cameras, ties, solved.points, water)
    blocks = [
        _dense(by_parameters(cameras, ties, solved.points, water_of, solved.parameters)),
        _by_pose(cameras, ties, solved.points, water),
        _by_lens(cameras, ties),
        _dense(_by_side(cameras, ties, solved.points, water, jx)),
    ]
    sizes = [block.shape[1] for block in blocks]
    pose_std = np.tile(np.repeat([errors.position_m, errors.direction_rad], 3), sizes[1] // 6)
    std = np.concatenate([prior_std, pose_std, np.full(sizes[2], errors.lens_px), np.full(sizes[3], errors.bed_m)])
    system = _System(ties, jx, csr_array(hstack(blocks)), solved.residuals, std**-2.0)
    pull = np.concatenate([solved.parameters - centre, np.zeros(sum(sizes[1:]))])
    weights = solved.weights
    for _ in range(_ROUNDS):
        step, residuals, inverse = system.solve(weights, pull, count)
        used, weights = weights, robust_weights(residuals)[0]
    spread = _by_cell(solved.points, errors.cell_m) @ system.scores(used, residuals) @ inverse.T
    # The points took their share of the scatter.
    spread = spread * np.sqrt(2 * len(ties.view) / (2 * len(ties.view) - 3 * len(ties)))
    ends = np.cumsum([0, *sizes])
    by_prior = [(inverse[:, a:b] * system.precision[a:b]) @ inverse[:, a:b].T for a, b in pairwise(ends)]
    return Freed(solved.parameters + step[:count], spread.T @ spread + by_prior[0], *by_prior[1:])


@dataclass(frozen=True)
class _System:
    """Residuals (N, 2), their derivatives by points (N, 2, 3) and errors (2 N, E) sparse, and 1 / variance (E,)."""

    ties: TiePoints
    jx: np.ndarray
    design: csr_array
    residuals: np.ndarray
    precision: np.ndarray

    def solve(self, weights: np.ndarray, pull: np.ndarray, count: int):
        """Errors (E,), the residuals (N, 2) that they leave, and the first rows of the inverse normal matrix."""
        ties, design = self.ties, self.design
        weighted = self._weighted(weights, design)
        own, right = np.zeros((len(ties), 3, 3)), np.zeros((len(ties), 3))
        np.add.at(own, ties.point, np.einsum("nai,naj,n->nij", self.jx, self.jx, weights))
        np.add.at(right, ties.point, np.einsum("nai,na,n->ni", self.jx, self.residuals, weights))
        rows = 2 * len(weights)
        columns = 3 * np.repeat(ties.point, 2)[:, None] + np.arange(3)
        places = (np.repeat(np.arange(rows), 3), columns.ravel())
        by_points = csr_array((self.jx.reshape(-1, 3).ravel(), places), shape=(rows, 3 * len(ties)))
        # With the root of the points' own matrices as left factor, the elimination is one product.
        root = block_diag(list(np.linalg.inv(np.linalg.cholesky(own))), format="csr")
        mixed = root @ (by_points.T @ weighted)
        normal = (design.T @ weighted - mixed.T @ mixed).toarray()
        normal[np.diag_indices_from(normal)] += self.precision
        free = root @ right.ravel()
        factor = cho_factor(normal)
        step = cho_solve(factor, weighted.T @ self.residuals.ravel() - mixed.T @ free - self.precision * pull)
        left = self.residuals.ravel() - design @ step - by_points @ (root.T @ (free - mixed @ step))
        return step, left.reshape(-1, 2), cho_solve(factor, np.eye(len(normal), count)).T

    def scores(self, weights: np.ndarray, residuals: np.ndarray) -> csr_array:
        """Scores of the points (M, E), sparse, at the residuals of a solution."""
        rows = 2 * len(weights)
        each = csr_array(self._weighted(weights, self.design).multiply(residuals.reshape(-1, 1)))
        places = (np.repeat(self.ties.point, 2), np.arange(rows))
        return csr_array((np.ones(rows), places), shape=(len(self.ties), rows)) @ each

    @staticmethod
    def _weighted(weights: np.ndarray, design: csr_array) -> csr_array:
        return csr_array(design.multiply(np.repeat(weights, 2)[:, None]))


def _by_cell(points: np.ndarray, cell_m: float) -> csr_array:
    """Sums over the points (M, 3) of each square of the ground, (cells, M): neighbours show the same relief."""
    _, cell = np.unique(np.floor(points[:, :2] / cell_m), axis=0, return_inverse=True)
    return csr_array((np.ones(len(points)), (cell.ravel(), np.arange(len(points)))))


def _by_side(cameras, ties: TiePoints, points: np.ndarray, water: FlatWater, jx: np.ndarray) -> np.ndarray:
    """Derivatives of the pixels (N, 2, 3) by three apparent rises [m] of a rough bed with the direction of view.

    Along the leg in water, t the tangent of its angle to the vertical: t^2 for all sides, and t east and north.
    """
    centres = np.array([camera.centre for camera in cameras])[ties.view]
    ends = points[ties.point]
    leg = crossing_point(ends, centres, water) - ends
    leg = np.where((leg[:, 2] > 0.0)[:, None], leg, centres - ends)
    tangent = leg[:, :2] / leg[:, 2:]
    sides = np.column_stack([np.sum(tangent**2, axis=1), tangent])
    return jx[:, :, 2, None] * sides[:, None, :]


def _dense(derivatives: np.ndarray) -> csr_array:
    return csr_array(derivatives.reshape(-1, derivatives.shape[-1]))


def _by_pose(cameras, ties: TiePoints, points: np.ndarray, water: FlatWater) -> csr_array:
    """Derivatives of the pixels by six errors of each camera, (2 N, 6 views)."""
    columns = []
    for move in _moves():
        ahead = pixels_of([move(camera, _STEP) for camera in cameras], ties, points, water)
        behind = pixels_of([move(camera, -_STEP) for camera in cameras], ties, points, water)
        columns.append((ahead - behind) / (2.0 * _STEP))
    values = np.stack(columns, axis=-1).reshape(-1, 6)
    places = (np.repeat(np.arange(len(values)), 6), (6 * np.repeat(ties.view, 2)[:, None] + np.arange(6)).ravel())
    return csr_array((values.ravel(), places), shape=(len(values), 6 * len(cameras)))


def _moves() -> list[Callable[[PinholeCamera, float], PinholeCamera]]:
    """Functions that shift a camera along the axes of local, and turn it about its own."""

    def shift(axis: np.ndarray):
        return lambda camera, by: replace(camera, centre=camera.centre + by * axis)

    def turn(axis: np.ndarray):
        return lambda camera, by: replace(
            camera, cam_from_local=Rotation.from_rotvec(by * axis).as_matrix() @ camera.cam_from_local
        )

    return [make(axis) for make in (shift, turn) for axis in np.eye(3)]


def _by_lens(cameras: Sequence[PinholeCamera], ties: TiePoints) -> csr_array:
    """Derivatives of the pixels by the coefficients of the fields of each lens, (2 N, 20 lenses)."""
    kinds = [(c.fx, c.fy, c.cx, c.cy, c.width, c.height, c.distortion) for c in cameras]
    number = np.array([kinds.index(kind) for kind in kinds])[ties.view]
    lenses, number = np.unique(number, return_inverse=True)
    sizes = np.array([(c.width, c.height) for c in cameras])[ties.view]
    fields = _polynomials(2.0 * ties.pixel / sizes - 1.0)
    count = fields.shape[1]
    first = (2 * number[:, None] + np.arange(2)).ravel() * count
    places = (np.repeat(np.arange(len(first)), count), (first[:, None] + np.arange(count)).ravel())
    shape = (len(first), 2 * count * len(lenses))
    return csr_array((np.repeat(fields, 2, axis=0).ravel(), places), shape=shape)


def _polynomials(places: np.ndarray) -> np.ndarray:
    """Polynomials (N, K) of degree 3 and less at (N, 2) from -1 to 1, orthonormal there: their mean square is 1."""
    scale = np.sqrt(2.0 * np.arange(_DEGREE + 1) + 1.0)
    along_x, along_y = (legendre.legvander(axis, _DEGREE) * scale for axis in places.T)
    pairs = [(i, j) for i in range(_DEGREE + 1) for j in range(_DEGREE + 1 - i)]
    return np.stack([along_x[:, i] * along_y[:, j] for i, j in pairs], axis=-1)
