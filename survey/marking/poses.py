"""Poses of the photographs that are marked: of a finished run, else of the poses file of the survey, else none."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from geo.errors import GeoError
from geo.frames import LocalFrame
from refract import FlatWater
from survey.errors import FILE_NAME, SurveyError
from survey.folder import infer
from survey.folder.file_poses import read_file_poses
from survey.folder.found import Found, find_survey
from survey.folder.motion import velocities_of, with_motion
from survey.folder.place import water_plane
from survey.names import RUN_FOLDER
from survey.photos.cameras import View
from survey.run.flight import FLIGHT, load_flight
from survey.settings.config import SurveyConfig, read_config
from survey.settings.control import ControlConfig
from survey.water.index import FRESH_WATER
from survey.water.tides import with_tides


@dataclass(frozen=True)
class Posed:
    """Photographs with poses."""

    source: str  # Where the poses come from, for a sentence
    frame: LocalFrame
    views: Mapping[str, View]  # dict of name to View
    water: FlatWater | None  # Local; None for dry ground, or where the level is not known yet


def survey_to_mark(folder: Path) -> tuple[SurveyConfig, Found]:
    """The settings of a survey, and what its folder holds but for control and clicks, which need not be there yet.

    Raises
    ------
    SurveyError, GeoError
        Where something else is missing, damaged or contradictory.
    """
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "does not exist"
        raise SurveyError(f"the survey folder {folder} {what}; expected a folder with photographs")
    toml = folder / FILE_NAME
    config = read_config(toml) if toml.is_file() else infer.config_of_folder(folder)
    bare = replace(config, control=ControlConfig())
    clicks = None if config.water is None else config.water.sources.clicks
    if clicks is not None and not (folder / clicks).is_file():
        bare = replace(bare, water=None)
    return config, find_survey(folder, config=bare)


def poses_to_mark(found: Found, run: Path | None) -> tuple[Posed | None, str | None]:
    """The best poses that there are, None where there are none, and then a note of what lacks.

    Parameters
    ----------
    found : Found
    run : Path or None
        A run folder whose poses are wanted; None: the one in the survey folder, if it has come to its end.

    Raises
    ------
    SurveyError
        Where the run that is named has no poses.
    """
    folder = found.folder / RUN_FOLDER if run is None else run
    if run is not None or (folder / FLIGHT).is_file():
        flight = load_flight(folder)
        return Posed(f"the run {folder}", flight.frame, {view.name: view for view in flight.views}, flight.water), None
    if found.poses_path is None:
        return None, (
            "no poses are known yet, so no places are predicted; after `bathynerf process --quality draft` they are"
        )
    try:
        return _of_file(found, found.poses_path), None
    except (SurveyError, GeoError) as error:
        return None, f"no places are predicted, the poses cannot be used: {error}"


def _of_file(found: Found, path: Path) -> Posed:
    """The photographs as the poses file of a survey places them, without the checks that `check` makes."""
    try:
        file, _ = read_file_poses(found, path)
    except SurveyError:
        if found.config.water is None or found.config.water.sources.clicks is None:
            raise
        # Clicks that tell no level yet.
        found = replace(found, config=replace(found.config, water=None))
        file, _ = read_file_poses(found, path)
    found, frame, views = file.found, file.frame, file.views
    places = {view.name: view.camera.centre for view in views}
    velocities = velocities_of(places, found.heads, found.config.cameras.speed_m_s)
    views, _ = with_motion(views, velocities, found.config.cameras)
    water = _water(found, frame, views)
    views, _ = with_tides(views, found.tide, water)
    return Posed(path.name, frame, {view.name: view for view in views}, water)


def _water(found: Found, frame: LocalFrame, views: list[View]) -> FlatWater | None:
    """The water plane, whose index is that of fresh water unless survey.toml gives it as a number.

    The light in the photographs, which `process` measures for it, changes a prediction by a thousandth of the depth.
    """
    given = found.config.water
    if given is None or given.level_m is None:
        return None
    if given.level_at is None:
        middle = frame.crs_from_local(np.mean([view.camera.centre for view in views], axis=0))
        given = replace(given, level_at=(float(middle[0]), float(middle[1])))
    return water_plane(frame, replace(given, refractive_index=given.refractive_index or FRESH_WATER))
