"""Whether poses, lens and water are adjusted to the photographs before the bed is searched."""

from __future__ import annotations

from survey.errors import SurveyError
from survey.folder.survey import Survey
from survey.plan.choices import Poses


def pose_choice(survey: Survey, asked: str, *, free_water: bool) -> tuple[str, str]:
    """Choice ("refine" or "fixed") and its reason, for the plan.

    Raises
    ------
    SurveyError
        If the water is to be found with poses that are to be kept.
    """
    if survey.is_adjusted:
        return "refine", "adjusted with lens and water; adjustment.json has what was found"
    if free_water and asked == Poses.fixed:
        raise SurveyError("--calibrate-water finds the water together with the poses; leave out --poses fixed")
    if asked != Poses.auto:
        return asked, "set by --poses"
    if survey.ties is not None:
        return "refine", "structure from motion has straight rays: poses, lens and water are adjusted with bent ones"
    if survey.control is not None:
        return "refine", "there are control points to adjust to"
    sources = {prior.source for prior in survey.priors.values()}
    if "survey.toml" in sources:
        return "refine", "survey.toml says how well the poses are known, and they are refined within that"
    if free_water:
        return "refine", "--calibrate-water finds the water together with what is uncertain of poses and lens"
    return "fixed", "poses from a file without position_std_m count as exact"
