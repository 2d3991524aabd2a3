"""Size of the photographs in a run, and what a pixel covers at it."""

from __future__ import annotations

import numpy as np

from refract import PinholeCamera
from survey.folder.survey import Survey
from survey.plan.area import flattened
from survey.plan.choices import USUAL, Choices
from survey.plan.heights import dry_ground
from survey.plan.recipe import RECIPES, image_scale


def image_scale_of(survey: Survey, chosen: Choices = USUAL) -> float:
    """Scale [-] of the photographs in a run, at most 1."""
    if chosen.image_scale is not None:
        return chosen.image_scale
    megapixels = RECIPES[chosen.quality].megapixels
    return min(image_scale(view.camera.width, view.camera.height, megapixels) for view in survey.views)


def gsd_m(survey: Survey, chosen: Choices = USUAL) -> float:
    """Ground sampling distance [m] at that scale, median over the views: at the water, or dry ground."""
    survey = flattened(survey)
    height = camera_height_m(survey)
    distances = [_distance_along_axis(view.camera, survey, height) / view.camera.fx for view in survey.views]
    return float(np.median(distances)) / image_scale_of(survey, chosen)


def camera_height_m(survey: Survey) -> float:
    """Height [m] of the cameras over the water or ground, median."""
    centres = np.array([view.camera.centre for view in survey.views])
    if survey.water is not None:
        return float(np.median(-survey.water.depth(centres)))
    return float(np.median(centres[:, 2])) - dry_ground(survey).height


def _distance_along_axis(camera: PinholeCamera, survey: Survey, height: float) -> float:
    """Distance [m] from the camera to water or ground along its axis, at most three heights."""
    own = height if survey.water is None else -float(survey.water.depth(camera.centre))
    falling = -camera.cam_from_local[2, 2]
    return own / max(falling, 1.0 / 3.0)
