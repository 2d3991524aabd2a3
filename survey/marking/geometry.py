"""Predicted positions and epipolar curves of marks through the water, by the poses of a run or of a file."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from geo.errors import GeoError
from geo.frames import LocalFrame
from refract import FlatWater
from survey.errors import SurveyError
from survey.folder.found import Found, find_survey, require_survey_folder
from survey.folder.local_frame import water_plane
from survey.folder.observations import velocities_of, with_motion
from survey.folder.pairing import read_file_poses
from survey.init.draft import settings_or_draft
from survey.photos.cameras import View, projection_and_jacobian
from survey.run.flight import FLIGHT, load_flight
from survey.settings.config import SurveyConfig
from survey.settings.tables import ControlConfig
from survey.water.level import FRESH_WATER
from survey.water.tides import with_tides
from survey.words import RUN_FOLDER

# Samples of a ray; the curves are smooth, and a photograph is some thousand pixels wide.
_SAMPLES = 400
# Curves begin at this share of the distance from the camera to the water, or to the other camera.
_NEAREST = 0.1
# A dry ray is followed to this multiple of the distance to the other camera, practically to infinity.
_FARTHEST = 300.0
# Longest leg under water [m]: no bed is seen through more.
_DEEPEST_M = 60.0
# Prior standard deviation of the place of a point [m], which makes its covariance finite without marks.
_UNKNOWN_M = 1.0


class Curve(NamedTuple):
    """An epipolar curve: pixels (N, 2) of the part of a ray above the water and of that below, in image order."""

    dry: np.ndarray
    wet: np.ndarray


def seen_at(view: View, place: np.ndarray, water: FlatWater | None) -> tuple[float, float] | None:
    """The pixel at which a photograph shows a place (3,), local; None where it does not show it."""
    pixel = view.camera.project(place, water)
    return (float(pixel[0]), float(pixel[1])) if view.camera.sees(pixel) else None


def epipolar_curve(source: View, pixel: tuple[float, float], target: View, water: FlatWater | None) -> Curve:
    """Epipolar curve of a pixel of `source`: the places along its ray, bent at the water, as `target` shows them.

    Samples are spaced evenly in the inverse of the distance above the water, evenly in length below.
    """
    path = source.camera.paths(np.array(pixel), water)
    baseline = float(np.linalg.norm(target.camera.centre - source.camera.centre))
    air, is_wet = float(path.air_length), bool(path.wet)
    if not np.isfinite(path.air_direction).all() or baseline == 0.0:
        return Curve(np.zeros((0, 2)), np.zeros((0, 2)))
    far = air if is_wet else _FARTHEST * baseline
    dry = 1.0 / np.linspace(1.0 / (_NEAREST * min(baseline, far)), 1.0 / far, _SAMPLES)
    wet = air + np.linspace(0.0, _DEEPEST_M, _SAMPLES) if is_wet else np.zeros(0)
    shown = target.camera.project(path.at(np.concatenate([dry, wet])), water)
    inside = target.camera.sees(shown)
    return Curve(shown[:_SAMPLES][inside[:_SAMPLES]], shown[_SAMPLES:][inside[_SAMPLES:]])


def crossing(view: View, pixel: tuple[float, float], water: FlatWater) -> np.ndarray | None:
    """Crossing of the ray of a pixel with the water (3,), local; None where it never meets it."""
    place = np.asarray(view.camera.paths(np.array(pixel), water).crossing)
    return place if np.isfinite(place).all() else None


def by_gain(
    views: Iterable[View], place: np.ndarray, water: FlatWater | None, marked: Sequence[View], std_px: float
) -> list[str]:
    """Names of photographs that show a place without a mark, by the trace of its covariance after one there."""

    def information(view: View) -> np.ndarray:
        """Information of a mark in a photograph about a place (3, 3) [1/m^2]."""
        _, slope = projection_and_jacobian(view.camera, place, water)
        # Behind a camera the projection has no derivatives.
        return slope.T @ slope / std_px**2 if np.isfinite(slope).all() else np.zeros((3, 3))

    known = np.eye(3) / _UNKNOWN_M**2 + sum(information(view) for view in marked)
    done = {view.name for view in marked}
    variance = {
        view.name: float(np.trace(np.linalg.inv(known + information(view))))
        for view in views
        if view.name not in done and seen_at(view, place, water) is not None
    }
    return sorted(variance, key=lambda name: (variance[name], name))


@dataclass(frozen=True)
class PosedSurvey:
    """Photographs with poses."""

    source: str  # Where the poses come from, for a sentence
    frame: LocalFrame
    views: Mapping[str, View]  # dict of name to View
    water: FlatWater | None  # Local; None for dry ground, or where the level is not known yet


def survey_to_mark(folder: Path) -> tuple[SurveyConfig, Found]:
    """The settings and contents of a survey folder, without control and clicks, which need not exist yet."""
    config = settings_or_draft(require_survey_folder(folder))
    bare = replace(config, control=ControlConfig())
    clicks = None if config.water is None else config.water.clicks
    if clicks is not None and not (folder / clicks).is_file():
        bare = replace(bare, water=None)
    return config, find_survey(folder, config=bare)


def poses_to_mark(found: Found, run: Path | None) -> tuple[PosedSurvey | None, str | None]:
    """The best available poses; where there are none, None and a note on what is missing.

    Without a run folder, the one in the survey folder counts, if it has come to its end.
    """
    folder = found.folder / RUN_FOLDER if run is None else run
    if run is not None or (folder / FLIGHT).is_file():
        flight = load_flight(folder)
        return PosedSurvey(
            f"the run {folder}", flight.frame, {view.name: view for view in flight.views}, flight.water
        ), None
    if found.poses_path is None:
        return None, (
            "no poses are known yet, so no positions are predicted; run `bathynerf process --quality draft` for poses"
        )
    try:
        return _of_file(found, found.poses_path), None
    except (SurveyError, GeoError) as error:
        return None, f"no positions are predicted, because the poses cannot be used: {error}"


def _of_file(found: Found, path: Path) -> PosedSurvey:
    """The photographs with the poses of the survey's poses file, without the checks of `check`."""
    try:
        placed, *_ = read_file_poses(found, path)
    except SurveyError:
        if found.config.water is None or found.config.water.clicks is None:
            raise
        # Clicks that tell no level yet.
        found = replace(found, config=replace(found.config, water=None))
        placed, *_ = read_file_poses(found, path)
    found, frame, views = placed.found, placed.frame, placed.views
    places = {view.name: view.camera.centre for view in views}
    velocities = velocities_of(places, found.headers, found.config.cameras.speed_m_s)
    views, _ = with_motion(views, velocities, found.config.cameras)
    water = _water(found, frame, views)
    views, _ = with_tides(views, found.tide, water)
    return PosedSurvey(path.name, frame, {view.name: view for view in views}, water)


def _water(found: Found, frame: LocalFrame, views: list[View]) -> FlatWater | None:
    """The water plane, whose index is that of fresh water unless survey.toml gives it: a thousandth of the depth."""
    given = found.config.water
    if given is None or given.level_m is None:
        return None
    if given.level_at is None:
        middle = frame.crs_from_local(np.mean([view.camera.centre for view in views], axis=0))
        given = replace(given, level_at=(float(middle[0]), float(middle[1])))
    return water_plane(frame, replace(given, refractive_index=given.refractive_index or FRESH_WATER))
