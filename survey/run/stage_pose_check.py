"""The stage that tests given poses and water on a sample of photographs."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from survey.adjust import pose_check
from survey.adjust.pose_check import PoseCheck
from survey.errors import Contradiction, SurveyError
from survey.files.json_values import write_json

if TYPE_CHECKING:
    from survey.run.job import Job

MISFIT = "misfit.json"


def check_poses(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Measure the reprojection misfit under the given poses, and test the given water and lens."""
    found = PoseCheck(None)
    with suppress(SurveyError):
        bound, block = job.bound, job.block
        with job.progress.stage("Poses", 1.0) as stage:
            found = pose_check.check_of_windows(job.survey, job.plan, block, bound, stage.advance)
    # Photographs without texture do not match in the sweep either, which reports it.
    if found.misfit_px is None and job.search is not None:
        with suppress(SurveyError):
            found = pose_check.check_of_features(job.survey, job.plan, job.search(job.survey).ties)
    write_json(folder / MISFIT, asdict(found))


def use_misfit(job: Job, folder: Path) -> None:
    """Update the plan by the result; raise where the level leaves dry what photographs show under water."""
    values = json.loads((folder / MISFIT).read_text(encoding="utf-8"))
    misfit, flooded = values["misfit_px"], values["flooded"]
    contradictions = tuple(Contradiction(**each) for each in values["contradictions"])
    found = PoseCheck(misfit, contradictions, None if flooded is None else Contradiction(**flooded))
    found.require_water()
    misfit_px = -1.0 if misfit is None else misfit
    provenance = replace(job.survey.provenance, pose_misfit_px=misfit_px, contradiction=found.contradiction)
    job.use_survey(replace(job.survey, provenance=provenance))
    choice, reason = job.plan.poses
    job.progress.note(f"plan: poses: {choice} ({reason})")
