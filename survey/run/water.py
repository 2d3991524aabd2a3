"""The self-calibration of the water as a stage of a run."""

from __future__ import annotations

import json
from dataclasses import replace

from survey.adjust.calibration import calibrate_water, with_water
from survey.adjust.water_estimate import PARAMETERS
from survey.folder.survey import Survey
from survey.plan.block import limits
from survey.progress import Progress
from survey.run.folder import RunDir, stage_key

_STAGE, _RESULT = "water", "water.json"
# Raise it when a change of the code changes the estimate, so that stored ones are not used again.
_FORMAT = 2


def calibrated(run: RunDir, survey: Survey, device: str, progress: Progress, *, resume: bool) -> Survey:
    """The survey with the water estimated from its photographs; what is not observable keeps its value."""
    key = stage_key(
        _STAGE, _FORMAT, *(view.path for view in survey.views), survey.views, survey.config.water, survey.bounds,
        limits(survey), device,
    )  # fmt: skip
    if not (resume and run.stage_is_current(_STAGE, key)):
        folder = run.open_stage(_STAGE)
        with progress.stage("Water", 1.0) as stage:
            found = calibrate_water(survey, device=device, advance=stage.advance)
        run.write_text(folder / _RESULT, found.to_json())
        run.finish_stage(_STAGE, key, folder)
    record = json.loads((run.load_stage(_STAGE) / _RESULT).read_text(encoding="utf-8"))
    for estimate in record["estimates"]:
        progress.note(f"water: {estimate['name']}: {estimate['verdict']}")
    notes = tuple(
        f"{estimate['name']} {estimate['verdict']} (from the photographs)" for estimate in record["estimates"]
    )
    water = replace(survey.config.water, **{name: record["water"][name] for name in PARAMETERS})
    return replace(with_water(survey, water), assumptions=survey.assumptions + notes)
