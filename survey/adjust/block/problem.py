"""An adjustment problem: observations, planes of an earlier survey among them, and priors of the unknowns.

With e the shift of the earlier survey, n the normal of a plane, h its height and s its strength, a point X adds
``s d^2`` with ``d = n . (X - e) - h`` to the sum of squares.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from survey.adjust.block.normal_matrix import EliminationOrder, elimination_order
from survey.adjust.block.prediction import predict
from survey.adjust.block.state import Layout, State
from survey.photos.poses import TiePoints


@dataclass(frozen=True)
class Planes:
    """Planes on which points are known to lie."""

    normal: np.ndarray  # (M, 3): Upwards, with 1 in z: the distance is along the vertical
    height: np.ndarray  # (M,) [m]: of ``normal . point`` on the plane.
    strength: np.ndarray  # (M,) [1/m^2]: inverse variance of that distance; 0 for points of which nothing is known

    def distances(self, points: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Vertical distances (M,) [m] of points (M, 3) above their planes shifted by (3,); 0 where there is none."""
        off = np.einsum("mi,mi->m", self.normal, points - shift) - self.height
        return np.where(self.strength > 0.0, off, 0.0)

    def squares(self, points: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """Squares (M,) of the distances, in units of variances."""
        return self.strength * self.distances(points, shift) ** 2

    def of_points(self, points: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Contribution to the normal matrices (M, 3, 3) and right sides (M, 3) of the points.

        The shift has the sums of both over the points, with the sign of the right sides reversed; the normal matrices
        of a point and the shift are those of the points with the sign reversed.
        """
        along = self.strength[:, None] * self.normal
        return along[:, :, None] * self.normal[:, None, :], -along * self.distances(points, shift)[:, None]


@dataclass(frozen=True)
class Priors:
    """Prior means and standard deviations of the unknowns; infinite where nothing is known."""

    state: State  # Mean values; its points are those of `point_std`
    std: np.ndarray  # (P,): of the parameters
    point_std: np.ndarray  # (M, 3) [m]
    # rows, signs (K, P), (K,): joint priors on several parameters: ``sign (row deviation)^2`` is added to the squares
    rows: np.ndarray | None = None
    signs: np.ndarray | None = None
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
        if self.rows is None or self.signs is None:
            return float(single @ single)
        return float(single @ single + self.signs @ (self.rows @ deviation) ** 2)


@dataclass(frozen=True)
class Problem:
    """A block to adjust."""

    layout: Layout
    ties: TiePoints  # In pixels of the photographs as they were taken
    kind: np.ndarray  # (N,) int64: of each observation; each kind has a standard deviation of its own
    priors: Priors
    given_std_px: np.ndarray  # (kinds,) [px]: standard deviations of the kinds; NaN where the residuals tell
    sides: np.ndarray  # (N, 3): see `survey.adjust.block.prediction.relief_sides`
    rows: np.ndarray | None = None  # (N,) [px], optional: see `survey.adjust.block.prediction.predict`
    # Nothing but points moves: parameters stay as they are in the state that the adjustment starts from, which saves
    # their part of the normal equations
    holds_parameters: bool = False

    @cached_property
    def order(self) -> EliminationOrder | None:
        """In which the parameters are eliminated; None where the normal matrix is best taken as dense."""
        return elimination_order(self.ties.point, self.ties.view, self.layout.photograph_of_parameters())

    def residuals(self, state: State) -> np.ndarray:
        """Measured less predicted pixels (N, 2)."""
        return self.ties.pixel - predict(self.layout, state, self.ties, self.sides, self.rows)
