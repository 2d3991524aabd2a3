"""A survey of kilometres over one plane, for what is planned once for all of it: overlap, heights, amounts of work."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from geo.crs import height_unit_m

if TYPE_CHECKING:
    from survey.folder.survey import Survey

# Level ground that falls by less than this [m] is one plane: over a kilometre it falls by 2 cm.
_LEAST_DROP_M = 0.05


def flattened(survey: Survey) -> Survey:
    """The survey with photographs and matched points as high over local z = 0 as they are in crs.

    Away from the origin level ground falls below z = 0: 10 km on by 7.8 m, more than some drones fly over it. The same
    survey where it falls by less than 5 cm.
    """
    centres = _raised(survey, np.array([view.camera.centre for view in survey.views]))
    if not np.isfinite(centres).all() or _drop(survey, centres) < _LEAST_DROP_M:
        return survey
    views = tuple(
        replace(view, camera=replace(view.camera, centre=centre))
        for view, centre in zip(survey.views, centres, strict=True)
    )
    observations, water = survey.observations, survey.water
    if observations.points is not None:
        observations = replace(observations, points=_raised(survey, observations.points))
    if water is not None:
        x, y, z = _raised(survey, np.array([water.point]))[0].tolist()
        slope_x, slope_y = survey.frame.local_from_grid(survey.frame.crs_from_local(np.array(water.point)))[:2, 2]
        # Slopes are against level, not against the plane that touches the Earth at the origin.
        water = replace(
            water,
            point=(x, y, z),
            slope_x=water.slope_x + float(slope_x),
            slope_y=water.slope_y + float(slope_y),
        )
    return replace(survey, views=views, water=water, observations=observations)


def _raised(survey: Survey, points: np.ndarray) -> np.ndarray:
    """Points (N, 3) [m], local, with their heights in crs over the origin as z."""
    frame = survey.frame
    heights = frame.crs_from_local(points)[:, 2] - frame.origin[2]
    return np.column_stack([points[:, :2], heights * height_unit_m(frame.crs)])


def _drop(survey: Survey, raised: np.ndarray) -> float:
    centres = np.array([view.camera.centre for view in survey.views])
    return float(np.abs(raised[:, 2] - centres[:, 2]).max())
