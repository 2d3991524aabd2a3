"""A level that has changed by little since the bed was searched: read again, of another gauge, in another datum.

The search takes most of a run. Where nothing else has changed, its results under the earlier plane are used again, and
the stage of the bed intersects the points anew along the rays of their photographs, bent at the plane that is asked
for (`survey.run.stage_bed.through_raised`); how near that is to a search under that plane is in docs/decisions.md.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from fields.models import IN_LAYER
from refract import FlatWater
from survey.display.quantities import length
from survey.files.json_values import read_json_object
from survey.plan.tile_choice import SHARED

if TYPE_CHECKING:
    from survey.run.folder import RunDir
    from survey.run.job import Job
    from survey.run.pipeline import Stage

# By more the photographs are matched elsewhere, and the search finds other points.
MOST_RAISED_M = 0.05
# Planes whose slopes differ by less are one, raised: local frames of two levels differ in the last digits.
_SAME_SLOPE = 1e-7


def search_under_earlier_level(job: Job, run: RunDir, search: Stage) -> None:
    """Let the job use what an earlier run has found under a plane of nearly the same level, if that is all there is.

    ``search`` is the first stage that depends on the level. A field and true colours are those of the level itself.
    """
    asked = job.survey
    if asked.water is None or asked.observations.departure is not None:
        return
    if job.plan.field in IN_LAYER or job.chosen.true_colour:
        return
    if run.finished_stage(search.name, search.key(job, {}), search.files) is not None:
        return
    for path in run.stages_path.glob(f"{search.name}-*/{SHARED}"):
        record = read_json_object(path).get("water")
        plane = None if record is None else FlatWater(**record)
        raised = None if plane is None else _raised_by(plane, asked.water)
        if raised is None or abs(raised) > MOST_RAISED_M:
            continue
        job.use_survey(replace(asked, water=plane))
        if run.finished_stage(search.name, search.key(job, {}), search.files) is not None:
            job.asked = asked
            job.progress.note(
                f"the level is {length(abs(raised))} {'higher' if raised > 0.0 else 'lower'} than when the bed was "
                "searched: its points are intersected again along their rays; --no-resume searches again"
            )
            return
    job.use_survey(asked)


def _raised_by(plane: FlatWater, asked: FlatWater) -> float | None:
    """By how much a plane is raised [m]; None where it is tilted, or of another index."""
    slopes = abs(asked.slope_x - plane.slope_x), abs(asked.slope_y - plane.slope_y)
    if max(slopes) > _SAME_SLOPE or asked.n_water != plane.n_water:
        return None
    return float(asked.point[2] - plane.height(*asked.point[:2]))
