"""The result of a comparison."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from survey.compare.figures import Figures
from survey.compare.inputs import Inputs


@dataclass(frozen=True)
class Comparison:
    """A finished comparison.

    Attributes
    ----------
    figures : Figures
    points : (N, 3), in crs
        The compared points.
    distances : (N,) [m]
        Theirs, signed; NaN where a reference of points does not surround them.
    nearest : (N, 3) [m], local
        The nearest points of the reference, or those of its surface straight above or below.
    depth : (N,) [m] or None
        Of the reference below the water at those, where it is known.
    targets : (M, 3), in crs
        What should be reached: the visible points, else samples of the reference.
    is_reached : (M,) bool
        At the first tolerance.
    inputs : Inputs
    """

    figures: Figures
    points: np.ndarray
    distances: np.ndarray
    nearest: np.ndarray
    depth: np.ndarray | None
    targets: np.ndarray
    is_reached: np.ndarray
    inputs: Inputs

    @property
    def distances_of_cloud(self) -> np.ndarray:
        """Distances of all points of the file [m], in its order, NaN outside the bounds."""
        distances = np.full(len(self.inputs.inside), np.nan)
        distances[self.inputs.inside] = self.distances
        return distances
