"""`bathynerf waterline`: what the photographs of a survey folder say about its water."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from geo.files import write_whole
from survey.adjust.water import Waterline, calibrate, nadir_views
from survey.errors import SurveyError
from survey.folder.config import WaterConfig
from survey.folder.inputs import survey_inputs
from survey.folder.place import water_plane
from survey.folder.survey import Survey, load_survey
from survey.outputs import is_json, require_file
from survey.progress import current


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
        Where the survey cannot be used, its photographs do not match, or the file cannot be written.
    """
    progress = current()
    require_file("--json", json_path, survey_inputs(Path(folder)), kind="a JSON file", is_of_kind=is_json)
    survey = load_survey(folder, report=progress.note)
    if survey.water is None:
        raise SurveyError("a dry survey has no water to estimate; give [water] level_m to start from")
    given = survey.config.water
    start = replace(
        given,
        level_m=given.level_m if start_level is None else start_level,
        refractive_index=given.refractive_index if start_index is None else start_index,
    )
    survey = with_water(survey, start)
    with progress.stage("Water", 1.0) as stage:
        found = calibrate(nadir_views(survey) if nadir_only else survey, device=device, advance=stage.advance)
    if json_path is not None:
        with write_whole(json_path) as stream:
            stream.write(found.to_json().encode())
    return found


def with_water(survey: Survey, water: WaterConfig) -> Survey:
    """The survey with other water."""
    config = replace(survey.config, water=water)
    return replace(survey, config=config, water=water_plane(survey.frame, water))
