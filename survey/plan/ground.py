"""The rough height of dry ground, from the cameras alone."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy.spatial import KDTree

from refract import PinholeCamera

# Overlap along the flight line that planners aim at; used only where the height of dry ground is unknown.
_USUAL_OVERLAP = 0.75
# All pairs of more cameras than this fill the memory; every second one, or third, tells the same.
_MOST_PAIRED = 1500


def ground_height(cameras: Sequence[PinholeCamera]) -> float:
    """Rough height [m], local, of the ground below cameras.

    Where the axes of oblique views converge, the median height at which pairs of them pass each other; else
    the ground at which neighbours overlap as usual.
    """
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    every = -(-len(cameras) // _MOST_PAIRED)
    i, j = (every * side for side in np.triu_indices(-(-len(cameras) // every), 1))
    cos = np.sum(axes[i] * axes[j], axis=1)
    convergent = cos < math.cos(math.radians(15.0))
    if convergent.sum() >= 10:
        i, j, cos = i[convergent], j[convergent], cos[convergent]
        between = centres[j] - centres[i]
        along_i, along_j = np.sum(between * axes[i], axis=1), np.sum(between * axes[j], axis=1)
        t = (along_i - cos * along_j) / (1.0 - cos**2)
        met = (centres[i] + t[:, None] * axes[i])[t > 0.0, 2]
        if met.size >= 10:
            return float(np.median(met))
    base = float(np.median(KDTree(centres[:, :2]).query(centres[:, :2], k=2)[0][:, 1]))
    camera = cameras[0]
    seen = min(camera.width / camera.fx, camera.height / camera.fy)
    return float(np.median(centres[:, 2]) - base / ((1.0 - _USUAL_OVERLAP) * seen))
