"""How often each photograph shows the bed, and how often it shows there what no other photograph does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fields.solver.solve import Solved


@dataclass(frozen=True)
class Sightings:
    """Pixels of the bed that photographs show, by the number of the photograph.

    Attributes
    ----------
    seen, outlying : (photographs,) int64
        All, and those whose residual lost most of its weight: glint, a shadow, something that moved.
    """

    seen: np.ndarray
    outlying: np.ndarray

    @staticmethod
    def none(photographs: int) -> Sightings:
        """Those before anything is solved."""
        return Sightings(*np.zeros((2, photographs), dtype=np.int64))

    @staticmethod
    def of(solved: Solved, photographs: int) -> Sightings:
        """Those of a solved tile, of a survey of so many photographs."""
        found, views = np.zeros((2, photographs), dtype=np.int64), list(solved.views)
        found[0, views] = np.count_nonzero(solved.brightness.weight > 0.0, axis=1)
        found[1, views] = np.count_nonzero(solved.brightness.outlying, axis=1)
        return Sightings(*found)

    def __add__(self, other: Sightings) -> Sightings:
        return Sightings(self.seen + other.seen, self.outlying + other.outlying)
