"""The stages before the bed is searched: a test of given poses on a sample of photographs, and the adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from survey.adjust import pose_check, refine
from survey.adjust.applied import CAMERAS, MODEL, apply_adjustment, write_cameras
from survey.adjust.pose_check import PoseCheck
from survey.adjust.result.adjustment import ARRAYS, JSON, read_adjustment, write_adjustment
from survey.errors import Findings, GivenValueTest, SurveyError
from survey.files.json_values import read_json_object, write_json

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
    tests, flooded = [asdict(each) for each in found.tests], found.flooded
    record = {"misfit_px": found.misfit_px, "contradictions": tests}
    write_json(folder / MISFIT, {**record, "flooded": None if flooded is None else asdict(flooded)})


def use_misfit(job: Job, folder: Path) -> None:
    """Update the plan by the result; raise where the level leaves dry what photographs show under water."""
    values = read_json_object(folder / MISFIT)
    misfit, flooded = values["misfit_px"], values["flooded"]
    tests = tuple(GivenValueTest(**each) for each in values["contradictions"])
    found = PoseCheck(misfit, tests, None if flooded is None else GivenValueTest(**flooded))
    found.require_water()
    misfit_px = -1.0 if misfit is None else misfit
    provenance = replace(job.survey.provenance, pose_misfit_px=misfit_px, contradiction=found.contradiction)
    job.use_survey(replace(job.survey, provenance=provenance))
    job.progress.detail(f"plan: poses: {job.plan.pose_choice} ({job.plan.pose_reason})")


FILES = (JSON, ARRAYS, CAMERAS, *MODEL)


def adjust_block(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Adjust the survey."""
    with job.progress.stage("Adjustment", 1.0) as stage:
        found = refine.adjust_survey(
            job.survey,
            device=job.plan.device_asked,
            advance=stage.advance,
            free_water=job.chosen.calibrate_water,
            search=job.search,
        )
    write_adjustment(folder, found)
    write_cameras(folder, apply_adjustment(job.survey, found), found)


def use_adjustment(job: Job, folder: Path) -> None:
    """Replace poses, lenses and water of the job by the adjusted ones."""
    found = read_adjustment(folder)
    survey = apply_adjustment(job.survey, found)
    sentences = [f"{row.name} {row.verdict}" for row in found.parameters]
    for text in (*sentences, *found.notes):
        job.progress.detail(f"adjustment: {text}")
    for text in found.warnings:
        job.progress.warn(text)
    job.use_survey(replace(survey, findings=survey.findings + Findings(found.notes, found.warnings)))
