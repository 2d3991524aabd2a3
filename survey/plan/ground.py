"""Approximate height of the dry ground of a survey."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from geo.crs import height_unit_m
from survey.folder.plausible import GroundHeight, ground_below

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# Fewer tie points do not tell a height: some of them may be wrong.
_FEWEST_POINTS = 50


def dry_ground(survey: Survey) -> GroundHeight:
    """Rough height of the ground of a survey, without regard to water.

    From the median of the tie points, else of the control points, else the middle of ``[area] heights``, else where
    the axes of oblique views converge, else where neighbours overlap as planners aim at.
    """
    points, control = survey.observations.points, survey.observations.control
    if points is not None and len(points) >= _FEWEST_POINTS:
        return GroundHeight(float(np.median(points[:, 2])), f"the median of {len(points):,} tie points")
    cameras = [view.camera for view in survey.views]
    if control is not None and control.points:
        # By their heights in crs: level ground kilometres from the origin lies metres below its z = 0.
        height = float(np.median([point.crs[2] for point in control.points])) - survey.frame.origin[2]
        return GroundHeight(
            height * height_unit_m(survey.frame.crs), f"the median of {len(control.points)} control points"
        )
    heights = survey.config.area.heights
    if heights is not None:
        place = survey.frame.crs_from_local(np.median([camera.centre for camera in cameras], axis=0))
        place[2] = 0.5 * sum(heights)
        return GroundHeight(float(survey.frame.local_from_crs(place)[2]), "the middle of [area] heights")
    return ground_below(cameras)
