"""The self-calibration of the water as a verb of its own, and as a stage of a run."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from geo.files import write_whole
from survey.adjust.water import PARAMETERS, Waterline, calibrate, nadir_views
from survey.errors import SurveyError
from survey.folder.config import WaterConfig
from survey.folder.place import water_plane
from survey.folder.survey import Survey, load_survey
from survey.progress import Progress, current
from survey.run.folder import RunDir, stage_key

_RESULT = "waterline.json"
# Raise it when a change of the code changes the estimate, so that stored ones are not used again.
_FORMAT = 1


def estimate_water(
    folder: Path,
    *,
    device: str = "auto",
    nadir_only: bool = False,
    start_level: float | None = None,
    start_index: float | None = None,
    json_path: Path | None = None,
) -> Waterline:
    """What the photographs of a survey folder say about its water; nothing in the folder changes.

    Parameters
    ----------
    folder : Path
    device : "auto", "cpu" or "cuda"
    nadir_only : bool
        Use only views that look down within 5 degrees of the vertical.
    start_level, start_index : [m], [-]
        Where the search starts, instead of at what the survey says.
    json_path : Path, optional
        Gets everything that was found.

    Raises
    ------
    SurveyError, GeoError
        Where the survey cannot be used, or its photographs do not match.
    """
    progress = current()
    survey = load_survey(folder, report=progress.note)
    if survey.water is None:
        raise SurveyError("a dry survey has no water to estimate; give [water] level_m to start from")
    given = survey.config.water
    start = replace(
        given,
        level_m=given.level_m if start_level is None else start_level,
        refractive_index=given.refractive_index if start_index is None else start_index,
    )
    survey = _with_water(survey, start)
    with progress.stage("Water", 1.0) as stage:
        found = calibrate(nadir_views(survey) if nadir_only else survey, device=device, advance=stage.advance)
    if json_path is not None:
        with write_whole(json_path) as stream:
            stream.write(found.to_json().encode())
    return found


def calibrated(run: RunDir, survey: Survey, device: str, progress: Progress, *, resume: bool) -> Survey:
    """The survey with the water that its photographs tell; what they cannot tell stays as it was given."""
    key = stage_key(
        "waterline", _FORMAT, *(view.path for view in survey.views), survey.views, survey.config.water, device
    )
    if not (resume and run.stage_is_current("waterline", key)):
        folder = run.open_stage("waterline")
        with progress.stage("Water", 1.0) as stage:
            found = calibrate(survey, device=device, advance=stage.advance)
        run.write_text(folder / _RESULT, found.to_json())
        run.finish_stage("waterline", key, folder)
    record = json.loads((run.load_stage("waterline") / _RESULT).read_text(encoding="utf-8"))
    for estimate in record["estimates"]:
        progress.note(f"water: {estimate['name']}: {estimate['verdict']}")
    notes = tuple(
        f"{estimate['name']} {estimate['verdict']} (from the photographs)" for estimate in record["estimates"]
    )
    water = replace(survey.config.water, **{name: record["water"][name] for name in PARAMETERS})
    return replace(_with_water(survey, water), assumptions=survey.assumptions + notes)


def _with_water(survey: Survey, water: WaterConfig) -> Survey:
    config = replace(survey.config, water=water)
    return replace(survey, config=config, water=water_plane(survey.frame, water))
