"""The stage that asks a sample of photographs whether poses that are given as exact can be."""

from __future__ import annotations

import json
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from survey.adjust import pose_check
from survey.errors import SurveyError
from survey.files.json_values import write_json

if TYPE_CHECKING:
    from survey.run.job import Job

MISFIT = "misfit.json"


def check_poses(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Measure by how much photographs miss each other under the given poses."""
    found = None
    with suppress(SurveyError):
        bound, block = job.bound, job.block
        with job.progress.stage("Poses", 1.0) as stage:
            found = pose_check.pose_misfit(job.survey, job.plan, block, bound, stage.advance)
    # Photographs without texture leave nothing that matches either: the sweep will say so.
    if found is None and job.search is not None:
        with suppress(SurveyError):
            found = pose_check.misfit_of_features(job.survey, job.plan, job.search(job.survey).ties)
    write_json(folder / MISFIT, {"misfit_px": found})


def use_misfit(job: Job, folder: Path) -> None:
    """Let the plan decide by the misfit."""
    found = json.loads((folder / MISFIT).read_text(encoding="utf-8"))["misfit_px"]
    job.take(replace(job.survey, pose_misfit_px=-1.0 if found is None else found))
    choice, reason = job.plan.poses
    job.progress.note(f"plan: poses: {choice} ({reason})")
