"""The rough height of dry ground: from points that are known there, or from the cameras alone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import KDTree

from geo.crs import height_unit_m
from refract import PinholeCamera

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# Fewer tie points, or pairs of axes, do not tell a height: some of them may be wrong.
_FEWEST_POINTS, _FEWEST_PAIRS = 50, 10
# Overlap along the flight line that planners aim at; used only where nothing tells the height of dry ground.
_USUAL_OVERLAP = 0.75
# All pairs of more cameras than this fill the memory; every second one, or third, tells the same.
_MOST_PAIRED = 1500


@dataclass(frozen=True)
class Ground:
    """Rough height of dry ground.

    Attributes
    ----------
    height : [m], local
    source : str
        What it is known from, for the plan.
    is_guess : bool
        Whether it is known from the usual overlap of photographs alone.
    """

    height: float
    source: str
    is_guess: bool = False


def dry_ground(survey: Survey) -> Ground:
    """Rough height of the ground of a survey, without regard to water.

    From the median of the tie points, else of the control points, else the middle of ``[area] heights``, else where
    the axes of oblique views converge, else where neighbours overlap as planners aim at.
    """
    if survey.points is not None and len(survey.points) >= _FEWEST_POINTS:
        return Ground(float(np.median(survey.points[:, 2])), f"the median of {len(survey.points):,} tie points")
    cameras = [view.camera for view in survey.views]
    if survey.control is not None and survey.control.points:
        places = np.array([point.local for point in survey.control.points])
        return Ground(float(np.median(places[:, 2])), f"the median of {len(places)} control points")
    heights_m = survey.config.area.heights
    if heights_m is not None:
        place = survey.frame.crs_from_local(np.median([camera.centre for camera in cameras], axis=0))
        place[2] = 0.5 * sum(heights_m) / height_unit_m(survey.frame.crs)
        return Ground(float(survey.frame.local_from_crs(place)[2]), "the middle of [area] heights")
    return ground_below(cameras)


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
    height = float(np.median(centres[:, 2]) - base / ((1.0 - _USUAL_OVERLAP) * seen))
    return Ground(height, f"a guess: neighbours overlap by {100 * _USUAL_OVERLAP:.0f} %", is_guess=True)
