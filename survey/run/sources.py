"""The photographs that have a height map, with their water: training data of fields and colours."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from fields.sweep.maps import Sources
from survey.plan.sweep_block import camera_of

if TYPE_CHECKING:
    from fields.sweep.maps import HeightMap
    from survey.run.job import Job


def sources_of(job: Job, maps: Sequence[HeightMap]) -> Sources:
    """Cameras, maps and colour images at the plan's scale, in the order of the maps."""
    survey, plan = job.survey, job.plan
    given = survey.config.water
    return Sources(
        [camera_of(survey.views[m.view], plan) for m in maps],
        maps,
        [job.photographs.load(survey.views[m.view], scale=plan.image_scale) for m in maps],
        survey.water,
        None if given is None else given.colour.absorption_per_m,
        None if given is None else given.colour.veiling_light,
    )
