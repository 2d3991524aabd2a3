"""How height maps rise from pixel to pixel: where a view looks along a wall, or over an edge."""

from __future__ import annotations

import cv2
import numpy as np


def is_steep(height: np.ndarray, tolerance: float) -> np.ndarray:
    """Which pixels (height, width) bool differ from their neighbours by more than what counts as agreement [m]."""
    return _slope(height) > tolerance


def _slope(height: np.ndarray) -> np.ndarray:
    """Rise from pixel to pixel (height, width) float32 [m] of the plane through 3x3 heights."""
    across, down = (cv2.Scharr(height, cv2.CV_32F, *order, scale=1.0 / 32.0) for order in ((1, 0), (0, 1)))
    return cv2.magnitude(across, down)
