"""How height maps rise from pixel to pixel: where a view looks along a wall, or over an edge."""

from __future__ import annotations

import cv2
import numpy as np

# Heights about a pixel on a wall lie in one plane: they leave it (rms) by less than this share of its rise. At a clean
# step it is 0.47.
_MOST_BENT = 0.4
# Where within the windows of the sweep an edge lies, it does not tell: heights this far from a pixel may be its own.
_BESIDE_PX = 5
# Rise from column to column of the plane through 3x3 heights.
_RISE = np.tile(np.array([-1.0, 0.0, 1.0], dtype=np.float32) / 6.0, (3, 1))


def steep_and_walls(height: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Which pixels (height, width) bool are steep, and which of these look along a wall: in one plane with all around.

    Steep is what differs from the neighbours by more than what counts as agreement, ``tolerance`` [m].
    """
    slope = slope_of(height)
    # About the middle of the map: squares of large heights would lose the small ones.
    height = height - np.median(height)
    mean, square = (cv2.blur(each, (3, 3)) for each in (height, height * height))
    # Along its rise the squares of a plane are two thirds of that of its slope.
    off_plane = square - mean * mean - (2.0 / 3.0) * slope * slope
    steep = slope > tolerance
    return steep, steep & (off_plane < (_MOST_BENT * slope) ** 2)


def differing(height: np.ndarray) -> np.ndarray:
    """By how much heights within two pixels differ from each other, half of their range (height, width) [m]."""
    about = np.ones((_BESIDE_PX, _BESIDE_PX), np.uint8)
    return 0.5 * (cv2.dilate(height, about) - cv2.erode(height, about))


def slope_of(height: np.ndarray) -> np.ndarray:
    """Rise from pixel to pixel (height, width) float32 [m] of the plane through 3x3 heights."""
    return cv2.magnitude(*rises_of(height))


def rises_of(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The rise of that plane across and down, (height, width) float32 [m] each."""
    across, down = (cv2.filter2D(height, -1, kernel) for kernel in (_RISE, _RISE.T))
    return across, down
