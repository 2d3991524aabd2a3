"""Planes fitted to the known heights around a pixel, to extrapolate the bed."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from refract import kernels

# Side of the square of heights through which a plane is fitted [px].
SIDE_PX = 13
# Of the square, at least such a share has to be known; and known pixels spread by so much [px], or they lie in a line.
_LEAST_KNOWN, _LEAST_SPREAD_PX = 0.1, 1.0
# Rows that are worked out together, of 200 bytes a pixel.
_ROWS = 64


def extrapolate_planes(height: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """Heights with unknown ones taken from the plane through the known ones around, where these lie in one.

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


@dataclass(frozen=True)
class Sums:
    """Sums over the square about each pixel, of known pixels (n) at places x, y from its middle with heights z.

    The pixels may be an array of any library, and of any shape.
    """

    n: Any
    x: Any
    y: Any
    z: Any
    xx: Any
    yy: Any
    xy: Any
    xz: Any
    yz: Any
    zz: Any

    @staticmethod
    def of(
        weight: Any, height: Any, along: Callable[[Any, int, int], Any], over: Callable[[Any], Any] | None = None
    ) -> Sums:
        """Sums of weights, 1 where a height is known, else 0, and of heights [m] times these, in float32.

        ``along(values, power, axis)`` are sums over a side of the square of values times a power of the distance
        [px], along rows (0) or columns (1), and ``over(values)`` those over the square.
        """
        w0, w1, w2 = (along(weight, power, 0) for power in range(3))
        z0, z1 = (along(height, power, 0) for power in range(2))
        square = height * height
        return Sums(
            n=along(w0, 0, 1), x=along(w1, 0, 1), y=along(w0, 1, 1), z=along(z0, 0, 1),
            xx=along(w2, 0, 1), yy=along(w0, 2, 1), xy=along(w1, 1, 1), xz=along(z1, 0, 1), yz=along(z0, 1, 1),
            zz=along(along(square, 0, 0), 0, 1) if over is None else over(square),
        )  # fmt: skip


def plane_through(sums: Sums) -> tuple[Any, Any]:
    """Height at the middle of each square of the plane through the known heights in it, and how far they leave it.

    The latter, a root mean square, is infinite where too few are known, or in a line.
    """
    xp = kernels.namespace(sums.n)
    each = 1.0 / xp.maximum(sums.n, 0.5)
    x, y, z = (part * each for part in (sums.x, sums.y, sums.z))
    xx, yy, xy = sums.xx * each - x * x, sums.yy * each - y * y, sums.xy * each - x * y
    xz, yz, zz = sums.xz * each - x * z, sums.yz * each - y * z, sums.zz * each - z * z
    # The determinant over the trace is nearly the variance in the direction in which the pixels spread least.
    spread = xx * yy - xy * xy
    enough = (sums.n >= _LEAST_KNOWN * SIDE_PX**2) & (spread > _LEAST_SPREAD_PX**2 * (xx + yy))
    over = 1.0 / xp.where(enough, spread, 1.0)
    across, down = (yy * xz - xy * yz) * over, (xx * yz - xy * xz) * over
    off = xp.sqrt(xp.maximum(zz - across * xz - down * yz, 0.0))
    return z - across * x - down * y, xp.where(enough, off, math.inf)


def _planes(height: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Height at each pixel of the plane through the known ones around it, and how far these leave it; inf without."""
    weight = known.astype(np.float32)
    base = np.float32(np.vdot(weight.astype(np.float64), height) / np.count_nonzero(known))
    plane, off = plane_through(Sums.of(weight, weight * (height - base), _along, _over))
    return base + plane, off


def _over(values: np.ndarray) -> np.ndarray:
    """Sums over the square."""
    return cv2.boxFilter(values, -1, (SIDE_PX, SIDE_PX), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _along(values: np.ndarray, power: int, axis: int) -> np.ndarray:
    """Sums over a side of the square of values times a power of the distance [px], along rows (0) or columns (1)."""
    kernels = [np.ones(1), (np.arange(SIDE_PX) - SIDE_PX // 2.0) ** power]
    along, other = kernels[::-1] if axis == 0 else kernels
    return cv2.sepFilter2D(values, -1, along, other, borderType=cv2.BORDER_CONSTANT)
