"""How far a ground has to reach."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from refract import PinholeCamera

# Margin beyond the view of the outermost pixels [m].
_MARGIN_M = 0.5


def seen_area(
    cameras: Sequence[PinholeCamera], size_m: tuple[float, float], lowest: float
) -> tuple[float, float, float, float]:
    """West, south, east and north [m], local, of an area about the origin and all that cameras see of a plane.

    Parameters
    ----------
    size_m : (east, north) [m]
        Of the area.
    lowest : [m]
        Height of a plane below all of the bed; rays count as straight, which reaches further than under water.
    """
    corners = [0.5 * np.array(size_m), -0.5 * np.array(size_m)]
    for camera in cameras:
        u, v = np.meshgrid([0.0, camera.width], [0.0, camera.height])
        rays = camera.directions(np.stack([u.ravel(), v.ravel()], axis=-1))
        t = (camera.centre[2] - lowest) / -rays[:, 2]
        corners.extend((camera.centre + t[:, None] * rays)[:, :2])
    low, high = np.min(corners, axis=0) - _MARGIN_M, np.max(corners, axis=0) + _MARGIN_M
    return float(low[0]), float(low[1]), float(high[0]), float(high[1])
