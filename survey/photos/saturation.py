"""Saturated pixels: glint of the sun and other white areas."""

from __future__ import annotations

import cv2
import numpy as np

# White, 255, less a margin for noise and JPEG [grey levels].
_WHITE = 250.0
# A photograph of which more than this share is white shows the sun, or its exposure, rather than the bed.
MOSTLY_WHITE = 0.5
# Width of the fainter rim of glint around saturated pixels, which hides the bed as well [px].
_RIM_PX = 1


def saturated(grey: np.ndarray) -> np.ndarray:
    """Saturated pixels of an image (height, width) of 0 to 255, and those beside them, (height, width) bool."""
    white = (grey >= _WHITE).astype(np.uint8)
    side = 2 * _RIM_PX + 1
    return cv2.dilate(white, np.ones((side, side), np.uint8)).astype(bool) if white.any() else white.astype(bool)
