"""The stage of the sweep: the bound of the bed, and a height map of each view that is needed to cover it."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from fields.sweep.free_space import without_contradicted
from fields.sweep.sweep import sweep
from survey.errors import SurveyError
from survey.files.json_values import write_json
from survey.plan.area import AREA_MARGIN_M, grown, limits, local_area, plane_name
from survey.progress import shares
from survey.run.stored import save_depth_maps

if TYPE_CHECKING:
    from survey.run.job import Job

MAPS, BOUND, SATURATED = "maps.npz", "bound.json", "saturated.json"


def sweep_views(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Sweep the views that cover the bed.

    Raises
    ------
    SurveyError
        If the images do not match, or no two views overlap.
    """
    survey, block = job.survey, job.block
    with job.progress.stage("Sweep", 1.0) as stage:
        low, high = job.bound
        block.look_at(0.5 * (low + high))
        area = local_area(survey)
        chosen = block.cover(*job.plan.recipe.times_seen, area)
        skips = job.plan.skips
        wanted = grown(area, AREA_MARGIN_M) if area is not None and skips.area else None
        ladder = (low, high) if skips.heights else limits(survey)
        maps = sweep(block, chosen, ladder, shares(stage), area=wanted)
        if not maps:
            raise SurveyError("no two views overlap; check that the poses belong to the images")
        maps = without_contradicted(block, maps)
    job.progress.note(f"bound: bed between {low:.2f} and {high:.2f} m over the {plane_name(survey)}")
    save_depth_maps(folder / MAPS, maps)
    write_json(folder / BOUND, {"low_m": low, "high_m": high})
    names = [view.name for view in survey.views]
    write_json(folder / SATURATED, dict(zip(names, block.saturated, strict=True)))


def look_at_bed(job: Job, folder: Path) -> None:
    """Let the block judge the overlap of views as at the end of the sweep, whether it ran now or in an earlier run."""
    bound = json.loads((folder / BOUND).read_text(encoding="utf-8"))
    job.block.look_at(0.5 * (bound["low_m"] + bound["high_m"]))
