"""The water of a survey from its photographs: for `bathynerf waterline`, and for the first stage of a run."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from geo.files import write_whole
from survey.adjust.water import LENS_STD_PX, POSE_STD_DEG, POSE_STD_M, water_from_ties
from survey.adjust.water_estimate import WaterEstimate
from survey.errors import SurveyError
from survey.files.outputs import is_json, require_file
from survey.folder.config import WaterConfig
from survey.folder.inputs import survey_inputs
from survey.folder.place import water_plane
from survey.folder.survey import Survey, load_survey
from survey.names import SFM_FOLDER
from survey.photos.tie_points import TiePoints
from survey.plan.area import limits, local_area
from survey.plan.block import camera_of, load_block
from survey.plan.plan import make_plan
from survey.progress import current

NADIR_DEG = 5.0


def estimate_water(
    folder: str | Path,
    *,
    device: str = "auto",
    nadir_only: bool = False,
    start_level: float | None = None,
    start_index: float | None = None,
    run_folder: str | Path | None = None,
    json_path: str | Path | None = None,
) -> WaterEstimate:
    """The water of a survey folder, estimated from its photographs; no setting and no result of a run changes.

    Parameters
    ----------
    folder : Path
    device : "auto", "cpu" or "cuda"
    nadir_only : bool
        Use only views that look down within 5 degrees of the vertical.
    start_level, start_index : [m], [-]
        Start of the search, instead of the values of the survey.
    run_folder : Path, optional
        Whose poses by structure from motion are used, for a survey that comes without poses; default
        ``folder/bathynerf``. Where it has none of these photographs they are solved for, and kept there.
    json_path : Path, optional
        Gets everything that was found.

    Raises
    ------
    SurveyError, GeoError
        Where the survey cannot be used, its photographs do not match, or the file cannot be written.
    """
    progress, folder = current(), Path(folder)
    run_folder = None if run_folder is None else Path(run_folder)
    json_path = None if json_path is None else Path(json_path)
    workspace = None if run_folder is None else run_folder / SFM_FOLDER
    if workspace is not None and not workspace.is_dir():
        raise SurveyError(
            f"{run_folder} has no poses by structure from motion (there is no folder {workspace}); name a run folder "
            "of this survey that has, or leave --run out"
        )
    if json_path is not None:
        require_file("--json", json_path, survey_inputs(folder), kind="a JSON file", is_of_kind=is_json)
    survey = load_survey(folder, workspace=workspace, report=progress.note)
    if survey.water is None:
        raise SurveyError("a dry survey has no water to estimate; give [water] level_m to start from")
    _, given = survey.require_water()
    start = replace(
        given,
        level_m=given.level_m if start_level is None else start_level,
        refractive_index=given.refractive_index if start_index is None else start_index,
    )
    survey = with_water(survey, start)
    with progress.stage("Water", 1.0) as stage:
        found = calibrate_water(nadir_views(survey) if nadir_only else survey, device=device, advance=stage.advance)
    if json_path is not None:
        with write_whole(json_path) as stream:
            stream.write(found.to_json().encode())
    return found


def with_water(survey: Survey, water: WaterConfig) -> Survey:
    """The survey with other water."""
    config = replace(survey.config, water=water)
    return replace(survey, config=config, water=water_plane(survey.frame, water))


def calibrate_water(
    survey: Survey,
    *,
    device: str = "auto",
    pose_std_m: float = POSE_STD_M,
    pose_std_deg: float = POSE_STD_DEG,
    lens_std_px: float = LENS_STD_PX,
    advance: Callable[[float], None] = lambda _share: None,
) -> WaterEstimate:
    """Estimate the water of a survey from its photographs.

    Parameters
    ----------
    survey : Survey
        Its water is where the search starts; half a metre off is near enough.
    device : "auto", "cpu" or "cuda"
    pose_std_m, pose_std_deg : [m], [deg]
        Standard deviation of a pose, per axis; of each photograph on its own.
    lens_std_px : [px]
        Root mean square of the worst error of the lens over an image.
    advance : callable
        Called with the increment; increments sum to 1.

    Raises
    ------
    SurveyError
        If the survey is dry, or its photographs do not match.
    """
    if survey.water is None:
        raise SurveyError("a dry survey has no water to estimate; give [water] level_m to start from")
    ties = measure_ties(survey, device=device, advance=advance)
    return water_from_ties(survey, ties, pose_std_m=pose_std_m, pose_std_deg=pose_std_deg, lens_std_px=lens_std_px)


def measure_ties(survey: Survey, *, device: str = "auto", advance: Callable[[float], None]) -> TiePoints:
    """The tie points of a survey, in pixels of its full-size photographs.

    Raises
    ------
    SurveyError
        If the photographs do not match.
    """
    # Starts Dr.Jit, which `water_from_ties` does not need.
    from survey.adjust.windows import measure

    plan = make_plan(survey, device=device)
    block = load_block(survey, plan, lambda _amount: None)
    try:
        ties = measure(block, limits(survey), local_area(survey), advance)
    except ValueError as error:
        raise SurveyError(str(error)) from error
    full = [(view.camera, camera_of(view, plan)) for view in survey.views]
    enlarge = np.array([(camera.fx / used.fx, camera.fy / used.fy) for camera, used in full])
    return within_bounds(survey, replace(ties, pixel=ties.pixel * enlarge[ties.view]))


def within_bounds(survey: Survey, ties: TiePoints) -> TiePoints:
    """The tie points inside the bounds of a survey, without a margin.

    The sweep knows their places to centimetres, and beyond the bounds there may be other water: a pond, a weir.
    """
    if survey.bounds is None:
        return ties
    e0, n0, e1, n1 = survey.bounds
    east, north, _ = survey.frame.crs_from_local(ties.start).T
    inside = (east >= e0) & (east <= e1) & (north >= n0) & (north <= n1)
    return ties.only(inside[ties.point])


def nadir_views(survey: Survey) -> Survey:
    """The survey with those views alone that look down within 5 degrees of the vertical.

    Raises
    ------
    SurveyError
        If there are fewer than three.
    """
    steep = math.cos(math.radians(NADIR_DEG))
    views = tuple(view for view in survey.views if -view.camera.cam_from_local[2, 2] > steep)
    if len(views) < 3:
        raise SurveyError(f"{len(views)} views look down within {NADIR_DEG:g} degrees, expected three or more")
    return replace(survey, views=views)
