"""Cameras and water in the local frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from refract import FlatWater
from survey.errors import FILE_NAME, ConfigError, Findings, PosesError
from survey.folder.found import Found
from survey.folder.pose_frames import cams_from_local, points_in_crs
from survey.photos.cameras import View
from survey.photos.poses import Pose, PoseFile, PoseFrame
from survey.photos.texture import matched_light
from survey.settings.config import SurveyConfig, WaterConfig
from survey.settings.water import MOST_LEVEL_STD_M, Medium
from survey.sfm.gps import frame_about
from survey.water.index import ASSUMED_INDEX_STD, refractive_index

# The search for an unknown level starts above this quantile of point heights, by this share of the flying height; few
# waters are deeper.
_TOP_OF_POINTS, _START_OVER_POINTS = 0.95, 0.1


def views_in_local(found: Found, file: PoseFile, poses: list[Pose]) -> tuple[LocalFrame, list[View]]:
    """The local frame of a survey with poses, and the views of some poses of the file.

    The frame is that of [local] where the poses are in it. Otherwise its origin lies under the middle of the cameras,
    at the height of the water, or of the lowest camera of a dry survey.
    """
    centres = np.array([pose.centre for pose in poses])
    if file.frame is PoseFrame.LOCAL:
        if found.config.local.origin is None:
            raise ValueError("poses in a local frame have no origin; expected what `place_poses` returns")
        frame = LocalFrame(found.crs, found.config.local.origin)
        return frame, [_view(found, pose, pose.centre, pose.cam_from_world) for pose in poses]
    in_crs = points_in_crs(file, centres, found.crs, found.config.cameras.gps_height)
    known = np.isfinite(in_crs).all(axis=1)
    water, places = found.config.water, in_crs[known] if known.any() else in_crs
    ground = places[:, 2].min() if water is None else water.known_level_m / height_unit_m(found.crs)
    frame = frame_about(found.crs, places, ground)
    local = frame.local_from_crs(in_crs)
    lost = ~np.isfinite(local).all(axis=1)
    if lost.any():
        bad = poses[int(np.argmax(lost))]
        raise PosesError(
            f"the position {bad.centre.tolist()} of {bad.name} in {found.poses_path} is not on the map of "
            f"{found.crs.name}; correct it, or crs in {FILE_NAME}"
        )
    rotations = cams_from_local(file, poses, in_crs, frame)
    return frame, [
        _view(found, pose, centre, rotation) for pose, centre, rotation in zip(poses, local, rotations, strict=True)
    ]


def _view(found: Found, pose: Pose, centre: np.ndarray, cam_from_local: np.ndarray) -> View:
    if pose.lens is None:
        raise ValueError(f"the pose of {pose.name} has no lens; expected what `with_lenses` returns")
    return View(pose.name, found.images[pose.name], pose.lens.camera(centre, cam_from_local), pose.lens)


def with_level_of_points(
    config: SurveyConfig, frame: LocalFrame, views: list[View], points: np.ndarray | None
) -> tuple[SurveyConfig, Findings]:
    """The settings with an initial level where none is given: a tenth of the flying height above the points.

    From too high a level the adjustment converges, because all points count as wet; below all points it has no
    information.
    """
    if config.water is None or points is None or not len(points):
        raise ConfigError(f"[water] in {FILE_NAME} has no level, and no matched points show one; give level_m")
    centres = np.array([view.camera.centre for view in views])
    x, y, _ = np.median(centres, axis=0)
    start = frame.crs_from_local(np.array([[x, y, over_points(points, centres)]]))[0, 2]
    level = round(float(start) * height_unit_m(frame.crs), 2)
    message = f"level_m is not given: the search for it starts at {level:g} m, above the matched points"
    water = replace(config.water, level_m=level, level_std_m=MOST_LEVEL_STD_M)
    return replace(config, water=water), Findings((message,))


def over_points(points: np.ndarray, centres: np.ndarray) -> float:
    """Initial height [m] of the water for the adjustment: over most of the points (N, 3), under cameras (V, 3)."""
    top = float(np.quantile(points[:, 2], _TOP_OF_POINTS))
    return top + _START_OVER_POINTS * max(float(np.median(centres[:, 2])) - top, 0.0)


def water_in_local(
    config: SurveyConfig, frame: LocalFrame, views: list[View]
) -> tuple[SurveyConfig, FlatWater | None, Findings]:
    """The water plane in local, and the settings with its defaults filled in.

    The plane touches at ``level_at``, by default under the middle of the cameras, and rises along the grid
    axes there as the slopes say.
    """
    given = config.water
    if given is None:
        return config, None, Findings()
    if given.level_at is None:
        middle = frame.crs_from_local(np.mean([view.camera.centre for view in views], axis=0))
        given = replace(given, level_at=(float(middle[0]), float(middle[1])))
    if not given.states_index:
        given = replace(given, index_std=ASSUMED_INDEX_STD)
    index, findings = refractive_index(given, lambda: matched_light(views))
    given = replace(given, refractive_index=index, medium=Medium())
    water = water_plane(frame, given)
    return replace(config, water=given), water, findings


def water_plane(frame: LocalFrame, given: WaterConfig) -> FlatWater:
    """The water plane in local."""
    if given.refractive_index is None:
        raise ValueError("refractive_index is not known before its default is filled in")
    point_crs = np.array([*given.known_level_at, given.known_level_m / height_unit_m(frame.crs)])
    point = frame.local_from_crs(point_crs)
    if not np.isfinite(point).all():
        raise ConfigError(f"[water] level_at is {list(given.known_level_at)}, not on the map of {frame.crs.name}")
    east, north, up = frame.local_from_grid(point_crs).T
    normal = np.cross(east + given.slope_east * up, north + given.slope_north * up)
    x, y, z = point.tolist()
    return FlatWater(
        point=(x, y, z),
        n_water=given.refractive_index,
        slope_x=float(-normal[0] / normal[2]),
        slope_y=float(-normal[1] / normal[2]),
    )
