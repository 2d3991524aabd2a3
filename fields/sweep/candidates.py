"""Candidates for points where heights along rays claim what is not near in space: beside edges, under overhangs.

The heights of the sweep are the least certain there, so that candidates are solved like the points before some of them
become points (`fields.solver.candidates`).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fields.image_store import Masks
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.map_points import MapPoints, far_from

# What other maps see through by more than this is no candidate [GSD].
REACH_GSD = 2.0
# Of drawn wrecks and boulders all candidates under overhangs that become points lie this near to steep pixels [px].
_AROUND_PX = 6


@dataclass(frozen=True)
class Selection:
    """Pixels of height maps, in the order of these.

    Attributes
    ----------
    kept : Masks
        Those that become points: every piece of the bed once.
    candidates : Masks
        Those that may: no point lies near them in space.
    sure : Masks
        Those whose heights count against a point.
    """

    kept: Masks
    candidates: Masks
    sure: Masks

    def together(self) -> Masks:
        """Kept pixels and candidates."""
        found = self.kept.copy()
        for number, mask in enumerate(self.candidates):
            found.add(number, mask)
        return found


def surroundings(steep: np.ndarray) -> np.ndarray:
    """Pixels (height, width) bool within `_AROUND_PX` of steep ones."""
    side = 2 * _AROUND_PX + 1
    return cv2.dilate(steep.view(np.uint8), np.ones((side, side), np.uint8)).view(bool)


def find_candidates(stack: ViewStack, confirmed: Masks, sure: Masks, kept: Masks, gsd: float) -> Masks:
    """Those of the ``confirmed`` pixels farther than ``gsd`` [m] from all points, that no map sees through.

    ``stack`` has the height maps.
    """
    found = Masks([mask.shape for mask in kept])
    new = MapPoints.of(stack, (fit & ~keep for fit, keep in zip(confirmed, kept, strict=True)))
    new = new[far_from(stack, kept, new.xyz, gsd)]
    _, through = new.votes(stack, sure, REACH_GSD * gsd)
    new[through == 0].mark(found, True)
    return found
