"""The stage of the adjustment: poses, lens and water found together, before the bed is searched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from survey.adjust import refine
from survey.adjust.applied import CAMERAS, MODEL, apply_adjustment, write_cameras
from survey.adjust.result.adjustment import ARRAYS, JSON, read_adjustment, write_adjustment
from survey.errors import Findings

if TYPE_CHECKING:
    from survey.run.job import Job

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
        job.progress.note(f"adjustment: {text}")
    for text in found.warnings:
        job.progress.warn(text)
    job.use_survey(replace(survey, findings=survey.findings + Findings(found.notes, found.warnings)))
