"""The photographs that have a height map, with their water: what fields and colours are learned from."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fields.sweep.sources import Sources
from survey.photos.images import load_image
from survey.plan.block import camera_of

if TYPE_CHECKING:
    from fields.sweep.sweep import DepthMap
    from survey.folder.survey import Survey
    from survey.plan.plan import Plan


def sources_of(survey: Survey, plan: Plan, maps: list[DepthMap]) -> Sources:
    """Cameras, maps and colour images at the plan's scale, in the order of the maps."""
    given = survey.config.water
    return Sources(
        [camera_of(survey.views[m.view], plan) for m in maps],
        maps,
        [load_image(survey.views[m.view], scale=plan.image_scale) for m in maps],
        survey.water,
        None if given is None else given.absorption_per_m,
        None if given is None else given.veiling_light,
    )
