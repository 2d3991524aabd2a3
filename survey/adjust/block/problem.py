"""An adjustment problem: observations, planes of an earlier survey among them, priors of the unknowns, Huber's weights.

With e the shift of the earlier survey, n the normal of a plane, h its height and s its precision, a point X adds
``s d^2`` with ``d = n . (X - e) - h`` to the sum of squares. Huber's loss takes residuals in units of the standard
deviation of their kind (P. J. Huber, Annals of Mathematical Statistics 35(1), 1964).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial.transform import Rotation

from evaluation import summary
from evaluation.summary import HUBER
from survey.adjust.block.normal_matrix import EliminationOrder, elimination_order
from survey.adjust.block.prediction import predict
from survey.adjust.block.state import NUM_POSE, Layout, State
from survey.photos.poses import TiePoints


@dataclass(frozen=True)
class Planes:
    """Planes on which points are known to lie."""

    normal: np.ndarray  # (M, 3): upwards, with 1 in z, so that distances are along the vertical
    height: np.ndarray  # (M,) [m]: ``normal . point`` on the plane
    precision: np.ndarray  # (M,) [1/m^2]: inverse variance of that distance; 0 for points of which nothing is known

    def of(self, points: np.ndarray) -> Planes:
        """The planes of some of the points, given by their numbers."""
        return Planes(self.normal[points], self.height[points], self.precision[points])

    def distances(self, points: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Vertical distances (M,) [m] of points (M, 3) above their planes shifted by (3,); 0 where there is none."""
        off = np.einsum("mi,mi->m", self.normal, points - shift) - self.height
        return np.where(self.precision > 0.0, off, 0.0)

    def squares(self, points: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Squares (M,) of the distances, in units of variances."""
        return self.precision * self.distances(points, shift) ** 2

    def of_points(self, points: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Contribution to the normal matrices (M, 3, 3) and right sides (M, 3) of the points.

        The shift has the sums of both over the points, with the sign of the right sides reversed; the normal matrices
        of a point and the shift are those of the points with the sign reversed.
        """
        along = self.precision[:, None] * self.normal
        return along[:, :, None] * self.normal[:, None, :], -along * self.distances(points, shift)[:, None]


@dataclass(frozen=True)
class Priors:
    """Prior means and standard deviations of the unknowns; infinite where nothing is known."""

    state: State  # Mean values; its points are those of `point_std`
    std: np.ndarray  # (P,): of the parameters
    point_std: np.ndarray  # (M, 3) [m]
    # rows, signs (K, P), (K,): joint priors on several parameters: ``sign (row deviation)^2`` is added to the squares
    rows: np.ndarray = field(default_factory=lambda: np.zeros((0, 0)))
    signs: np.ndarray = field(default_factory=lambda: np.zeros(0))
    planes: Planes | None = None  # optional: on which points lie

    def deviation(self, layout: Layout, state: State) -> np.ndarray:
        """Parameters of a state less their mean values, (P,)."""
        turns = Rotation.from_matrix(state.rotations @ self.state.rotations.transpose(0, 2, 1)).as_rotvec()
        poses = np.concatenate([state.centres - self.state.centres, turns], axis=1)
        water = state.water_parameters() - self.state.water_parameters()
        lenses = (state.lenses - self.state.lenses).ravel()
        readouts = (state.readouts - self.state.readouts)[: layout.first_rate - layout.first_readout]
        rate = np.full(layout.first_focal - layout.first_rate, state.rate - self.state.rate)
        relief, shift = state.relief - self.state.relief, state.shift - self.state.shift
        focals = state.focals - self.state.focals
        return np.concatenate([water, relief, shift, lenses, readouts, rate, focals, poses.ravel()])

    def squares(self, layout: Layout, state: State) -> float:
        """The sum of squares of the parameters, in units of variances."""
        deviation = self.deviation(layout, state)
        single = deviation / self.std
        joint = self.signs @ (self.rows @ deviation) ** 2 if len(self.signs) else 0.0
        return float(single @ single + joint)


class AlikeObservations(NamedTuple):
    """G groups of observations, each of one point in photographs that share all parameters but their poses."""

    point: np.ndarray  # (G,) int64
    columns: np.ndarray  # (G, K) int64: the numbers of these parameters
    summed: csr_array  # (G, N): sums over the observations of each group


@dataclass(frozen=True)
class Problem:
    """A block to adjust."""

    layout: Layout
    ties: TiePoints  # In pixels of the photographs as they were taken
    kind: np.ndarray  # (N,) int64: of each observation; each kind has a standard deviation of its own
    priors: Priors
    given_std_px: np.ndarray  # (kinds,) [px]: standard deviations of the kinds; NaN where the residuals tell
    rise_design: np.ndarray  # (N, 3): see `survey.adjust.block.prediction.apparent_rise_design`
    rows: np.ndarray | None = None  # (N,) [px], optional: see `survey.adjust.block.prediction.predict`
    # Nothing but points moves: parameters stay as they are in the state that the adjustment starts from, which saves
    # their part of the normal equations
    holds_parameters: bool = False

    @cached_property
    def order(self) -> EliminationOrder | None:
        """Order in which the parameters are eliminated; None where the normal matrix is best taken as dense."""
        return elimination_order(self.ties.point, self.ties.view, self.layout.photograph_of_parameters())

    @cached_property
    def rows_of_views(self) -> list[np.ndarray]:
        """Numbers of the observations in each photograph."""
        order = np.argsort(self.ties.view, kind="stable")
        return np.split(order, np.searchsorted(self.ties.view[order], np.arange(1, len(self.layout.lens_of))))

    @cached_property
    def alike(self) -> AlikeObservations:
        """The observations by points and the parameters that their photographs share."""
        shared, number = np.unique(self.layout.columns[:, :-NUM_POSE], axis=0, return_inverse=True)
        group, of_group = np.unique(self.ties.point * len(shared) + number.ravel()[self.ties.view], return_inverse=True)
        summed = csr_array((np.ones(len(of_group)), of_group, np.arange(len(of_group) + 1)))
        return AlikeObservations(group // len(shared), shared[group % len(shared)], csr_array(summed.T))

    def observations_of(self, points: np.ndarray) -> np.ndarray:
        """Numbers of the observations of points, given by their ascending numbers."""
        chosen = np.zeros(len(self.ties), dtype=bool)
        chosen[points] = True
        return np.flatnonzero(chosen[self.ties.point])

    def of_points(self, points: np.ndarray) -> Problem:
        """The problem of some of the points, given by their ascending numbers, with all parameters."""
        kept, priors = self.observations_of(points), self.priors
        number = np.zeros(len(self.ties), dtype=np.int64)
        number[points] = np.arange(len(points))
        ties = TiePoints(
            self.ties.start[points],
            number[self.ties.point[kept]],
            self.ties.view[kept],
            self.ties.pixel[kept],
            self.ties.least,
        )
        return replace(
            self,
            ties=ties,
            kind=self.kind[kept],
            priors=replace(
                priors,
                state=replace(priors.state, points=priors.state.points[points]),
                point_std=priors.point_std[points],
                planes=None if priors.planes is None else priors.planes.of(points),
            ),
            rise_design=self.rise_design[kept],
            rows=None if self.rows is None else self.rows[kept],
        )

    def residuals(self, state: State) -> np.ndarray:
        """Measured less predicted pixels (N, 2)."""
        return self.ties.pixel - predict(self.layout, state, self.ties, self.rise_design, self.rows)


# The median of the length of a two-dimensional normal deviate of unit standard deviation per axis, sqrt(2 ln 2).
_MEDIAN_LENGTH = 1.1774
# Of two photographs residuals lie across epipolar lines: that of a deviate along one axis with the same mean square.
_MEDIAN_OF_TWO = 0.9539


def huber_loss(length: np.ndarray) -> np.ndarray:
    """Huber's loss of residuals of a length in standard deviations: the square within the bound, linear beyond."""
    return np.where(length < HUBER, length**2, HUBER * (2.0 * length - HUBER))


def std_of_kinds(problem: Problem, residuals: np.ndarray, taken: float) -> np.ndarray:
    """Standard deviation [px] of a coordinate of each kind of observation, from the median of its residuals (N, 2).

    ``taken`` is how many coordinates the parameters take.
    """
    length = np.linalg.norm(residuals, axis=1)
    # Each point takes three of the coordinates that its observations have.
    seen = np.bincount(problem.ties.point, minlength=len(problem.ties))[problem.ties.point]
    left = 1.0 - taken / max(2 * len(problem.kind) - 3 * len(problem.ties), 1)
    spare = np.sqrt(np.maximum((1.0 - 1.5 / seen) * left, 0.1))
    spare = np.where(seen == 2, _MEDIAN_OF_TWO / _MEDIAN_LENGTH, 1.0) * spare
    std = problem.given_std_px.copy()
    present = np.bincount(problem.kind, minlength=len(std)) > 0
    # Of a kind that was not observed, any number does.
    std[~present & np.isnan(std)] = 1.0
    for kind in np.flatnonzero(np.isnan(std)):
        scaled = (length / spare)[(problem.kind == kind) & np.isfinite(length)]
        std[kind] = max(float(np.median(scaled)) / _MEDIAN_LENGTH, 1e-3) if len(scaled) else 1.0
    return std


def huber_weights(problem: Problem, residuals: np.ndarray, std_px: np.ndarray) -> np.ndarray:
    """Huber weights (N,) [1/px^2]; zero where there is no residual."""
    std, length = std_px[problem.kind], np.linalg.norm(residuals, axis=1)
    weights = summary.huber_weights(length, std) / std**2
    return np.where(np.isfinite(length), weights, 0.0)
