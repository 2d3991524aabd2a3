"""Planes fitted to the heights around a pixel: to extrapolate the bed, and for slopes, walls and edges."""

from __future__ import annotations

import cv2
import numpy as np

# Heights around a pixel on a wall lie in one plane: residuals (rms) below this share of its slope. A step has 0.47.
_MOST_BENT = 0.4
# An edge is located to the windows of the sweep only: heights within this square may be those of its pixel [px].
_NEAR_PX = 5
# Rise from column to column of the plane through 3x3 heights.
_RISE = np.tile(np.array([-1.0, 0.0, 1.0], dtype=np.float32) / 6.0, (3, 1))


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


SIDE_PX = 13  # Side of the square of heights through which a plane is fitted [px]
# Of the square, at least such a share has to be known; and known pixels spread by so much [px], or they lie in a line.
_LEAST_KNOWN, _LEAST_SPREAD_PX = 0.1, 1.0
_ROWS = 64  # Rows that are worked out together, of 200 bytes a pixel


def extrapolate_planes(height: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """Heights with unknown ones taken from the plane through the known ones around, where these lie in one.

    ``height`` (height, width) float32 [m]. ``known`` (height, width) bool. ``tolerance`` [m]: known heights lie in a
    plane if they leave it (rms) by less. Beside an edge they do not, and nothing is changed. Returns (height, width)
    float32 [m].
    """
    found, halo = height.copy(), SIDE_PX // 2
    for first in range(0, len(height), _ROWS):
        rows = slice(first, first + _ROWS)
        around = slice(max(first - halo, 0), first + _ROWS + halo)
        seen = np.flatnonzero(known[around].any(axis=0))
        if known[rows].all() or not len(seen):
            continue
        # A window shows a tile of the ground in a part of its columns.
        columns = slice(max(seen[0] - halo, 0), seen[-1] + halo + 1)
        plane, off = _planes(height[around, columns], known[around, columns])
        inner = slice(first - around.start, first - around.start + len(height[rows]))
        take = ~known[rows, columns] & (off[inner] < tolerance)
        found[rows, columns][take] = plane[inner][take]
    return found


def _planes(height: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height at each pixel of the plane through the known ones in the square about it, and how far these leave it.

    The latter, a root mean square, is infinite where too few are known, or in a line.
    """
    weight = known.astype(np.float32)
    base = np.float32(np.vdot(weight.astype(np.float64), height) / np.count_nonzero(known))
    over_base = weight * (height - base)
    w0, w1, w2 = (_along(weight, power, 0) for power in range(3))
    z0, z1 = (_along(over_base, power, 0) for power in range(2))
    n = _along(w0, 0, 1)
    # Means over the known pixels of places x, y from the middle, heights z, and their products.
    each = 1.0 / np.maximum(n, 0.5)
    x, y, z = _along(w1, 0, 1) * each, _along(w0, 1, 1) * each, _along(z0, 0, 1) * each
    xx, yy, xy = (
        _along(w2, 0, 1) * each - x * x, _along(w0, 2, 1) * each - y * y, _along(w1, 1, 1) * each - x * y
    )  # fmt: skip
    xz, yz, zz = (
        _along(z1, 0, 1) * each - x * z, _along(z0, 1, 1) * each - y * z, _over(over_base * over_base) * each - z * z
    )  # fmt: skip
    # The determinant over the trace is nearly the variance in the direction in which the pixels spread least.
    spread = xx * yy - xy * xy
    enough = (n >= _LEAST_KNOWN * SIDE_PX**2) & (spread > _LEAST_SPREAD_PX**2 * (xx + yy))
    over = 1.0 / np.where(enough, spread, 1.0)
    across, down = (yy * xz - xy * yz) * over, (xx * yz - xy * xz) * over
    off = np.sqrt(np.maximum(zz - across * xz - down * yz, 0.0))
    return base + (z - across * x - down * y), np.where(enough, off, np.inf)


def _over(values: np.ndarray) -> np.ndarray:
    """Sums over the square."""
    return cv2.boxFilter(values, -1, (SIDE_PX, SIDE_PX), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _along(values: np.ndarray, power: int, axis: int) -> np.ndarray:
    """Sums over a side of the square of values times a power of the distance [px], along rows (0) or columns (1)."""
    kernels = [np.ones(1), (np.arange(SIDE_PX) - SIDE_PX // 2.0) ** power]
    along, other = kernels[::-1] if axis == 0 else kernels
    return cv2.sepFilter2D(values, -1, along, other, borderType=cv2.BORDER_CONSTANT)
