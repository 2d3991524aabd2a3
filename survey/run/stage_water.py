"""The stage of the water: level, slopes and index, estimated from the photographs before the bed is searched."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from geo.files import write_whole
from survey.adjust import calibration
from survey.adjust.water_estimate import PARAMETERS

if TYPE_CHECKING:
    from survey.run.job import Job

ESTIMATE = "water.json"


def calibrate_water(job: Job, folder: Path, _needs: Mapping[str, Path]) -> None:
    """Estimate the water."""
    with job.progress.stage("Water", 1.0) as stage:
        found = calibration.calibrate_water(job.survey, device=job.plan.device_asked, advance=stage.advance)
    with write_whole(folder / ESTIMATE) as stream:
        stream.write(found.to_json().encode())


def use_water(job: Job, folder: Path) -> None:
    """Give the job the water that was found; what is not observable keeps its value."""
    record = json.loads((folder / ESTIMATE).read_text(encoding="utf-8"))
    for estimate in record["estimates"]:
        job.progress.note(f"water: {estimate['name']}: {estimate['verdict']}")
    notes = tuple(f"{found['name']} {found['verdict']} (from the photographs)" for found in record["estimates"])
    survey = job.survey
    _, given = survey.require_water()
    water = replace(given, **{name: record["water"][name] for name in PARAMETERS})
    job.take(replace(calibration.with_water(survey, water), assumptions=survey.assumptions + notes))
