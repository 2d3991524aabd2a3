"""Occlusion: cells of the bed hidden in a photograph by others in front.

The heights of the bed are projected into the photograph. A cell is hidden where the bed at its pixel is seen higher:
cameras look from above, so that along a ray the higher bed is the nearer one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from refract import PinholeCamera
from survey.export.sight import Sight, Windows

# A cell is hidden where the bed that is seen at its pixel is higher by so many cells.
_HIDDEN_CELLS = 3.0
# Side of the blocks of pixels that are told apart, in cells of the bed: so that each has one.
_BLOCK_CELLS = 1.5


@dataclass(frozen=True)
class Tops:
    """The highest bed in each block of a photograph's pixels.

    Attributes
    ----------
    height : (rows, columns) [m]
        -inf where there is none.
    block : [px]
        Side.
    allowed : [m]
        By so much a cell may lie lower and be seen.
    """

    height: np.ndarray
    block: float
    allowed: float

    @staticmethod
    def of(camera: PinholeCamera, bed: Windows, *, cell_m: float, cell_px: float) -> Tops:
        """Those of a camera.

        Parameters
        ----------
        camera : PinholeCamera
        bed : Windows
        cell_m, cell_px : [m], [px]
            Side of a cell of the bed, on the bed and in the photograph.
        """
        block = max(_BLOCK_CELLS * cell_px, 1.0)
        highest = np.full((int(camera.height / block) + 1, int(camera.width / block) + 1), -np.inf)
        tops = Tops(highest, block, _HIDDEN_CELLS * cell_m)
        for _, height, sight in bed.through(camera):
            seen, place = tops._block_of(sight)
            np.maximum.at(highest, tuple(at[seen] for at in place), height[seen])
        return tops

    def unhidden(self, sight: Sight, height: np.ndarray) -> Sight:
        """What is seen of cells with these heights (rows, columns) [m]; NaN where something hides them."""
        seen, place = self._block_of(sight)
        return sight.where(seen & (np.where(seen, height, -np.inf) >= self.height[place] - self.allowed))

    def _block_of(self, sight: Sight) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Which cells are in the photograph, and the row and column of their blocks."""
        seen = np.isfinite(sight.u)
        rows, columns = (np.where(seen, at, 0.0) / self.block for at in (sight.v, sight.u))
        return seen, (rows.astype(np.int64), columns.astype(np.int64))
