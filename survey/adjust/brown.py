"""Brown's lens in the adjustment: distortion in normalised coordinates, and its derivatives.

    x, y    where a ray meets the plane at depth 1 in cam
    r^2     x^2 + y^2

    x_d = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2), and y likewise with p1 and p2 in turn,

as OpenCV and COLMAP have it (D. C. Brown, Photogrammetric Engineering 32(3), 1966).
"""

from __future__ import annotations

import numpy as np

COEFFICIENTS = ("k1", "k2", "k3", "p1", "p2")


def distort(xy: np.ndarray, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distorted coordinates (N, 2), and their derivatives by xy (N, 2, 2) and by the coefficients (N, 2, 5).

    Parameters
    ----------
    xy : (N, 2)
    coefficients : (N, 5)
        In the order of `COEFFICIENTS`.
    """
    x, y = xy.T
    k1, k2, k3, p1, p2 = coefficients.T
    xx, yy, xy2 = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    out = np.stack(
        [x * radial + p1 * xy2 + p2 * (r2 + 2.0 * xx), y * radial + p2 * xy2 + p1 * (r2 + 2.0 * yy)], axis=-1
    )
    mixed = x * y * slope + 2.0 * (p1 * x + p2 * y)
    by_x = radial + xx * slope + 2.0 * p1 * y + 6.0 * p2 * x
    by_y = radial + yy * slope + 2.0 * p2 * x + 6.0 * p1 * y
    by_xy = np.stack([np.stack([by_x, mixed], axis=-1), np.stack([mixed, by_y], axis=-1)], axis=-2)
    powers = r2[:, None] ** np.arange(1, 4)
    along_x = np.column_stack([x[:, None] * powers, xy2, r2 + 2.0 * xx])
    along_y = np.column_stack([y[:, None] * powers, r2 + 2.0 * yy, xy2])
    return out, by_xy, np.stack([along_x, along_y], axis=1)
