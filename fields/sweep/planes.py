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
    weight = known.astype(np.float64)
    base = float(np.vdot(weight, height) / weight.sum())
    columns, rows = (np.arange(n) - 0.5 * n for n in height.shape[::-1])
    x, y, z = weight * columns, weight * rows[:, None], weight * (height - base)

    def box(values: np.ndarray) -> np.ndarray:
        return cv2.boxFilter(values, cv2.CV_64F, (SIDE_PX, SIDE_PX), borderType=cv2.BORDER_CONSTANT)

    share = box(weight)
    each = 1.0 / np.maximum(share, 0.5 / SIDE_PX**2)
    x_mean, y_mean, z_mean = box(x) * each, box(y) * each, box(z) * each
    xx, yy, zz = (box(a * a) * each - mean * mean for a, mean in ((x, x_mean), (y, y_mean), (z, z_mean)))
    xy, xz, yz = (
        box(a * b) * each - a_mean * b_mean
        for a, a_mean, b, b_mean in ((x, x_mean, y, y_mean), (x, x_mean, z, z_mean), (y, y_mean, z, z_mean))
    )
    # The determinant over the trace is nearly the variance in the direction in which the pixels spread least.
    spread = xx * yy - xy * xy
    enough = (share >= _LEAST_KNOWN) & (spread > _LEAST_SPREAD_PX**2 * (xx + yy))
    over = 1.0 / np.where(enough, spread, 1.0)
    across, down = (yy * xz - xy * yz) * over, (xx * yz - xy * xz) * over
    plane = base + z_mean + across * (columns - x_mean) + down * (rows[:, None] - y_mean)
    off = np.sqrt(np.maximum(zz - across * xz - down * yz, 0.0))
    return plane, np.where(enough, off, np.inf)
