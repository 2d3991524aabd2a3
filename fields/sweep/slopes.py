"""Slopes of height maps, and the filter of steep pixels: walls and edges."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fields.image_store import Masks
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.map_points import MapPoints, far_from, thin_out

# Heights around a pixel on a wall lie in one plane: residuals (rms) below this share of its slope. A step has 0.47.
_MOST_BENT = 0.4
# An edge is located to the windows of the sweep only: heights within this square may be those of its pixel [px].
_NEAR_PX = 5
# Rise from column to column of the plane through 3x3 heights.
_RISE = np.tile(np.array([-1.0, 0.0, 1.0], dtype=np.float32) / 6.0, (3, 1))
# A steep pixel is dropped if more maps see through its point than contain it. One is added if so many maps contain it
# and at most this share of them see through it.
_LEAST_FOR, _MOST_AGAINST = 4, 0.25
# Gaps that are filled have this radius, in ground sampling distances.
_GAP_GSD = 1.25


def steep_and_wall_pixels(height: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Steep pixels (height, width) bool, and those of them on a wall: in one plane with all around.

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


def half_range(height: np.ndarray) -> np.ndarray:
    """Half of the range of the heights within two pixels, (height, width) [m]."""
    about = np.ones((_NEAR_PX, _NEAR_PX), np.uint8)
    return 0.5 * (cv2.dilate(height, about) - cv2.erode(height, about))


def slope_of(height: np.ndarray) -> np.ndarray:
    """Slope (height, width) float32 [m per pixel] of the plane through 3x3 heights."""
    return cv2.magnitude(*gradient_of(height))


def gradient_of(height: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradient of that plane along columns and rows, (height, width) float32 [m per pixel] each."""
    across, down = (cv2.filter2D(height, -1, kernel) for kernel in (_RISE, _RISE.T))
    return across, down


@dataclass(frozen=True)
class SteepPixels:
    """Steep pixels of height maps."""

    steep: Masks
    fit: Masks  # Those of them that may be added
    sure: Masks  # All pixels, steep or not, whose heights count against a point


def filter_steep_pixels(stack: ViewStack, found: SteepPixels, kept: Masks, gsd: float) -> None:
    """Update the ``kept`` pixels: drop steep ones that other maps see through, add others that fill gaps on walls.

    ``stack`` has the height maps. A map contains a point within ``gsd`` [m] of its heights there, and sees
    through one farther above them.
    """
    if not len(kept):
        return
    old = MapPoints.of(stack, (keep & steep for keep, steep in zip(kept, found.steep, strict=True)))
    having, through, _ = old.votes(stack, found.sure, gsd)
    old[through > having].mark(kept, False)
    new = MapPoints.of(stack, (fit & ~keep for fit, keep in zip(found.fit, kept, strict=True)))
    new = new[far_from(stack, kept, new.xyz, _GAP_GSD * gsd)]
    having, through, _ = new.votes(stack, found.sure, gsd)
    new = new[(having >= _LEAST_FOR) & (through <= _MOST_AGAINST * having)]
    new[thin_out(new.xyz.T, _GAP_GSD * gsd)].mark(kept, True)
