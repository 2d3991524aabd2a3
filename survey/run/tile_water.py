"""Water of one tile of a survey whose water is no plane: its own plane, and heights that count from it."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from survey.plan.tiling import Area
from survey.plan.water_tiles import places_of

if TYPE_CHECKING:
    from refract import FlatWater, PinholeCamera
    from survey.folder.survey import Survey


def over_own_plane(survey: Survey, ground: Area, bound: tuple[float, float]) -> tuple[Survey, tuple[float, float]]:
    """A survey over the plane that fits its water best on some ground, and the bound [m] of the bed over it.

    As they are where the water of the survey is a plane.
    """
    water, departure = survey.water, survey.observations.departure
    if water is None or departure is None:
        return survey, bound
    places = places_of(ground)
    plane = departure.tangent(places, water)
    higher = plane.height(*places.T) - water.height(*places.T)
    observations = replace(survey.observations, departure=departure.over(water, plane))
    low, high = bound[0] - float(higher.max()), bound[1] - float(higher.min())
    return replace(survey, water=plane, observations=observations), (low, high)


def heights_over(
    water: FlatWater | None, own: FlatWater | None, camera: PinholeCamera, pixels: np.ndarray, heights: np.ndarray
) -> np.ndarray:
    """Heights (N,) [m] over the water of a survey of what pixels (N, 2) show at heights over the water of a tile."""
    if water is None or own is None or own == water:
        return heights
    xyz = camera.paths(pixels, own).at_height(heights.astype(np.float64), own)
    return ((xyz - np.array(water.point)) @ np.array(water.up)).astype(heights.dtype)
