"""An adjustment problem: observations, and priors of the unknowns."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from survey.adjust.block.planes import Planes
from survey.adjust.block.prediction import predict
from survey.adjust.block.state import Layout, State
from survey.photos.tie_points import TiePoints


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

    def residuals(self, state: State) -> np.ndarray:
        """Measured less predicted pixels (N, 2)."""
        return self.ties.pixel - predict(self.layout, state, self.ties, self.sides, self.rows)
