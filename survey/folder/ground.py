"""Approximate height of dry ground, from the cameras alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from refract import PinholeCamera

# Fewer pairs of axes do not tell a height.
_FEWEST_PAIRS = 10
# Overlap along the flight line that planners aim at; used only where nothing tells the height of dry ground.
USUAL_OVERLAP = 0.75
# All pairs of more cameras than this fill the memory; every second one, or third, tells the same.
_MOST_PAIRED = 1500


@dataclass(frozen=True)
class Ground:
    """Rough height of dry ground."""

    height: float  # [m], local
    source: str  # What it is known from, for the plan
    is_guess: bool = False  # Whether it is known from the usual overlap of photographs alone


def ground_below(cameras: Sequence[PinholeCamera]) -> Ground:
    """Rough height of the ground below cameras, from their poses alone.

    Where the axes of oblique views converge, the median height at which pairs of them pass each other; else
    the height at which neighbours overlap as usual, a guess.
    """
    centres = np.array([camera.centre for camera in cameras])
    axes = np.array([camera.cam_from_local[2] for camera in cameras])
    every = -(-len(cameras) // _MOST_PAIRED)
    i, j = (every * side for side in np.triu_indices(-(-len(cameras) // every), 1))
    cos = np.sum(axes[i] * axes[j], axis=1)
    convergent = cos < math.cos(math.radians(15.0))
    if convergent.sum() >= _FEWEST_PAIRS:
        i, j, cos = i[convergent], j[convergent], cos[convergent]
        between = centres[j] - centres[i]
        along_i, along_j = np.sum(between * axes[i], axis=1), np.sum(between * axes[j], axis=1)
        t = (along_i - cos * along_j) / (1.0 - cos**2)
        met = (centres[i] + t[:, None] * axes[i])[t > 0.0, 2]
        if met.size >= _FEWEST_PAIRS:
            return Ground(float(np.median(met)), "where the axes of oblique views converge")
    base = float(np.median(KDTree(centres[:, :2]).query(centres[:, :2], k=2)[0][:, 1]))
    camera = cameras[0]
    seen = min(camera.width / camera.fx, camera.height / camera.fy)
    height = float(np.median(centres[:, 2]) - base / ((1.0 - USUAL_OVERLAP) * seen))
    return Ground(height, f"a guess: neighbours overlap by {100 * USUAL_OVERLAP:.0f} %", is_guess=True)
