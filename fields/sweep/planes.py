"""Where the bed goes on: planes through the heights around a pixel that are known."""

from __future__ import annotations

import cv2
import numpy as np

# Heights within a square of this side are known about its middle, or no plane is laid through them [px].
SIDE_PX = 13
# Of the square, at least such a share has to be known; and known pixels spread by so much [px], or they lie in a line.
_LEAST_KNOWN, _LEAST_SPREAD_PX = 0.1, 1.0
# Rows that are worked out together, of 200 bytes a pixel.
_ROWS = 64


def continued(height: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """Heights in which unknown ones are those of the plane through the known ones around, where these lie in one.

    Parameters
    ----------
    height : (height, width) float32 [m]
    known : (height, width) bool
    tolerance : [m]
        Known heights lie in a plane if they leave it (rms) by less. Beside an edge they do not, and nothing is changed.

    Returns
    -------
    (height, width) float32 [m]
    """
    found, halo = height.copy(), SIDE_PX // 2
    for first in range(0, len(height), _ROWS):
        rows = slice(first, first + _ROWS)
        around = slice(max(first - halo, 0), first + _ROWS + halo)
        if known[rows].all() or not known[around].any():
            continue
        plane, off = _planes(height[around], known[around])
        inner = slice(first - around.start, first - around.start + len(height[rows]))
        take = ~known[rows] & (off[inner] < tolerance)
        found[rows][take] = plane[inner][take]
    return found


def _planes(height: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height at each pixel of the plane through the known ones around it, and how far these leave it; inf without."""
    weight = known.astype(np.float32)
    base = np.float32(np.vdot(weight.astype(np.float64), height) / np.count_nonzero(known))
    z = weight * (height - base)
    # Sums over the square with powers of the distance from its middle, which float32 holds: along rows, then columns.
    w0, w1, w2 = (_along(weight, power, 0) for power in range(3))
    z0, z1 = (_along(z, power, 0) for power in range(2))
    share = _along(w0, 0, 1)
    each = 1.0 / np.maximum(share, np.float32(0.5))
    x_mean, y_mean, z_mean = (sums * each for sums in (_along(w1, 0, 1), _along(w0, 1, 1), _along(z0, 0, 1)))
    xx = _along(w2, 0, 1) * each - x_mean * x_mean
    yy = _along(w0, 2, 1) * each - y_mean * y_mean
    xy = _along(w1, 1, 1) * each - x_mean * y_mean
    xz = _along(z1, 0, 1) * each - x_mean * z_mean
    yz = _along(z0, 1, 1) * each - y_mean * z_mean
    zz = cv2.boxFilter(z * z, -1, (SIDE_PX, SIDE_PX), normalize=False, borderType=cv2.BORDER_CONSTANT) * each
    # The determinant over the trace is nearly the variance in the direction in which the pixels spread least.
    spread = xx * yy - xy * xy
    enough = (share >= _LEAST_KNOWN * SIDE_PX**2) & (spread > _LEAST_SPREAD_PX**2 * (xx + yy))
    over = 1.0 / np.where(enough, spread, np.float32(1.0))
    across, down = (yy * xz - xy * yz) * over, (xx * yz - xy * xz) * over
    plane = base + z_mean - across * x_mean - down * y_mean
    off = np.sqrt(np.maximum(zz - z_mean * z_mean - across * xz - down * yz, 0.0))
    return plane, np.where(enough, off, np.float32(np.inf))


def _along(values: np.ndarray, power: int, axis: int) -> np.ndarray:
    """Sums over a side of the square of values times a power of the distance [px], along rows (0) or columns (1)."""
    kernels = [np.ones(1), (np.arange(SIDE_PX) - SIDE_PX // 2.0) ** power]
    along, other = kernels[::-1] if axis == 0 else kernels
    return cv2.sepFilter2D(values, -1, along, other, borderType=cv2.BORDER_CONSTANT)
