"""A rendered view: colours, heights, distances and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NovelView:
    """A rendered view; NaN, and black, where the camera sees nothing.

    Attributes
    ----------
    rgb : (height, width, 3) uint8
        As a photograph stores it.
    bed_height : (height, width) float32 [m]
        Over the water plane (over local z = 0 without water), negative below it.
    distance : (height, width) float32 [m]
        From the camera to the bed along the path, air and water legs together.
    normal : (height, width, 3) float32 unit, local
        Of the bed, up.
    """

    rgb: np.ndarray
    bed_height: np.ndarray
    distance: np.ndarray
    normal: np.ndarray

    @property
    def seen(self) -> np.ndarray:
        """(height, width) bool: pixels that show something."""
        return np.isfinite(self.bed_height)
