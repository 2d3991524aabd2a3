"""A rendered view: colours, heights, distances and normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NovelView:
    """A rendered view; NaN, and black, where the camera sees nothing."""

    rgb: np.ndarray  # (height, width, 3) uint8: as a photograph stores it
    # (height, width) float32 [m]: over the water plane (over local z = 0 without water), negative below it
    bed_height: np.ndarray
    # (height, width) float32 [m]: from the camera to the bed along the path, air and water legs together
    distance: np.ndarray
    normal: np.ndarray  # (height, width, 3) float32 unit, local: of the bed, up

    @property
    def seen(self) -> np.ndarray:
        """(height, width) bool: pixels that show something."""
        return np.isfinite(self.bed_height)
