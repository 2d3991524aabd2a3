"""Windows of a survey, matched to a fraction of a pixel, in pixels of its photographs as they were taken."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.photos.tie_points import TiePoints
from survey.plan.area import limits, local_area
from survey.plan.block import camera_of, load_block
from survey.plan.choices import Choices
from survey.plan.plan import Plan, make_plan

if TYPE_CHECKING:
    from fields.sweep.block import Block


def measure_windows(survey: Survey, *, device: str = "auto", advance: Callable[[float], None]) -> TiePoints:
    """The windows of a survey as tie points.

    Raises
    ------
    SurveyError
        If the photographs do not match.
    """
    plan = make_plan(survey, Choices(device=device))
    return windows_of_block(survey, plan, *loaded(survey, plan), advance)


def loaded(survey: Survey, plan: Plan) -> tuple[Block, tuple[float, float]]:
    """The photographs of a survey, and the range of heights over the water plane [m] in which its bed lies.

    Raises
    ------
    SurveyError
        If the photographs do not match.
    """
    # Starts Dr.Jit, which the adjustment does not need.
    from fields.sweep.ranging import find_range

    block = load_block(survey, plan, lambda _amount: None)
    try:
        return block, find_range(block, limits(survey))
    except ValueError as error:
        raise SurveyError(str(error)) from error


def windows_of_block(
    survey: Survey,
    plan: Plan,
    block: Block,
    bound: tuple[float, float],
    advance: Callable[[float], None],
    *,
    sparse: bool = False,
) -> TiePoints:
    """The same of a survey whose photographs are loaded, and of which the range of heights is known.

    ``sparse`` takes fewer windows: as many as means over photographs need.
    """
    from survey.adjust.windows import DENSE, SPARSE, measure

    ties = measure(block, bound, local_area(survey), advance, SPARSE if sparse else DENSE)
    full = [(view.camera, camera_of(view, plan)) for view in survey.views]
    enlarge = np.array([(camera.fx / used.fx, camera.fy / used.fy) for camera, used in full])
    return replace(ties, pixel=ties.pixel * enlarge[ties.view])
