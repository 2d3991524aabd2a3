"""Windows of a survey, matched to a fraction of a pixel, in pixels of its photographs as they were taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from refract.lens import distorted
from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints
from survey.plan.area import limits, local_area
from survey.plan.block import camera_of, load_block
from survey.plan.plan import make_plan


def measure_windows(survey: Survey, *, device: str = "auto", advance: Callable[[float], None]) -> TiePoints:
    """The windows of a survey as tie points.

    Raises
    ------
    SurveyError
        If the photographs do not match.
    """
    # Starts Dr.Jit, which the adjustment does not need.
    from survey.adjust.windows import measure

    plan = make_plan(survey, device=device)
    block = load_block(survey, plan, lambda _amount: None)
    try:
        ties = measure(block, limits(survey), local_area(survey), advance)
    except ValueError as error:
        raise SurveyError(str(error)) from error
    full = [(view.camera, camera_of(view, plan)) for view in survey.views]
    enlarge = np.array([(camera.fx / used.fx, camera.fy / used.fy) for camera, used in full])
    pixel = ties.pixel * enlarge[ties.view]
    for number, view in enumerate(survey.views):
        mine = ties.view == number
        if mine.any():
            pixel[mine] = distorted(view.lens, pixel[mine])
    return replace(ties, pixel=pixel)
