"""Poses and points of a file, cameras and water in crs and in the local frame; the reprojection error of tie points."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

import geo.crs
from geo.compatibility import crs_difference
from geo.frames import LocalFrame
from geo.projection import MapProjection, enu_from_geocentric, geocentric_from_geodetic, geodetic_from_geocentric
from geo.transformation import Transformation, height_scale
from refract import FlatWater
from survey.errors import FILE_NAME, ConfigError, Findings, PosesError
from survey.files.csv_table import same_unit
from survey.files.point_table import Units
from survey.folder.found import Found
from survey.photos.cameras import View
from survey.photos.poses import FileTies, Pose, PoseFile, PoseFrame
from survey.photos.texture import matched_light
from survey.settings.config import MOST_LEVEL_STD_M, NO_MEDIUM, SurveyConfig, WaterConfig
from survey.sfm.gps import area_at, frame_about, height_transformer
from survey.water.level import ASSUMED_INDEX_STD, refractive_index

_WGS84 = CRS("EPSG:4979")
_HEIGHTS = "the heights of the poses"
# The search for an unknown level starts above this quantile of point heights, by this share of the flying height; few
# waters are deeper.
_TOP_OF_POINTS, _START_OVER_POINTS = 0.95, 0.1


def points_in_crs(file: PoseFile, points: np.ndarray, crs: CRS, gps_height: str) -> np.ndarray:
    """Points (N, 3) in the frame of a poses file, which is not LOCAL, as (N, 3) in crs; NaN off the map.

    Geocentric heights are those of GPS: heights in crs, or above the ellipsoid, as `gps_height` says.
    """
    if file.frame is PoseFrame.GEOCENTRIC:
        return _from_geocentric(file, points, crs, gps_height)
    own_units = Units.of(crs if file.crs is None else file.crs)
    units = Units(file.plan_unit_m, file.height_unit_m).meant(own_units)
    fault = units.plan_fault(own_units)
    if fault is not None:
        raise PosesError(f"the file of poses: {fault}; convert them")
    if file.crs is None:
        return points * [1.0, 1.0, units.height_factor(Units.of(crs))]
    stated, own = units.height_m, geo.crs.height_unit_m(file.crs) if geo.crs.has_height(file.crs) else None
    if stated is not None and own is not None and not same_unit(stated, own):
        raise PosesError(
            f"{_HEIGHTS} are in units of {stated:.10g} m by the name of their column, and of {own:.10g} m by the CRS "
            "of their file; correct one of them"
        )
    height = points[:, 2] * height_scale(file.crs, crs, _HEIGHTS, unit_m=units.height_m)
    if crs_difference(geo.crs.horizontal_crs(file.crs), geo.crs.horizontal_crs(crs)) is None:
        return np.column_stack([points[:, :2], height])
    transformation = Transformation.between(file.crs, crs, points)
    return np.column_stack([*transformation(points[:, 0], points[:, 1]), height])


def _from_geocentric(file: PoseFile, points: np.ndarray, crs: CRS, gps_height: str) -> np.ndarray:
    own = _WGS84 if file.crs is None else file.crs
    if geo.crs.prime_meridian_rad(own) or geo.crs.angular_unit_rad(own) != math.radians(1.0):
        raise PosesError(f"the poses are geocentric on {own.name}, whose degrees are not from Greenwich; export WGS 84")
    lon, lat, height = geodetic(file, points)
    east, north = Transformation.between(geo.crs.geodetic_crs(own), crs, np.column_stack([lon, lat]))(lon, lat)
    if file.crs is not None and geo.crs.has_height(file.crs):
        if geo.crs.vertical_crs(file.crs) is not None:
            height_scale(file.crs, crs, _HEIGHTS)
        # Geocentric heights are ellipsoidal: of heights over a geoid, the program has added that.
        gps_height = "ellipsoidal"
    if gps_height == "crs":
        return np.column_stack([east, north, height / geo.crs.height_unit_m(crs)])
    known = np.isfinite(lon) & np.isfinite(lat)
    to_height = height_transformer(crs, area_at(lon[known], lat[known]))
    return np.column_stack([east, north, to_height.transform(lon, lat, height)[2]])


def geodetic(file: PoseFile, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Longitudes and latitudes [deg] and heights [m] above the ellipsoid of geocentric points (..., 3) of a file."""
    axes = geo.crs.ellipsoid(_WGS84 if file.crs is None else file.crs)
    lon, lat, height = geodetic_from_geocentric(points, a=axes.semi_major_metre, b=axes.semi_minor_metre)
    return np.degrees(lon), np.degrees(lat), height


def transformation_into_crs(file: PoseFile, crs: CRS) -> Transformation | None:
    """The transformation of the poses of a file into crs; None where they are in crs, or in a local frame."""
    places = np.array([pose.centre for pose in file.poses])
    if file.frame is PoseFrame.LOCAL or not len(places):
        return None
    if file.frame is PoseFrame.GEOCENTRIC:
        own = geo.crs.geodetic_crs(_WGS84 if file.crs is None else file.crs)
        return Transformation.between(own, crs, np.column_stack(geodetic(file, places)[:2]))
    return None if file.crs is None else Transformation.between(file.crs, crs, places)


def cams_from_local(file: PoseFile, poses: Sequence[Pose], centres_crs: np.ndarray, frame: LocalFrame) -> np.ndarray:
    """Rotations (N, 3, 3) of poses of a file from local, with their centres (N, 3) in crs; NaN off the map."""
    rotations, centres = np.array([pose.cam_from_world for pose in poses]), np.array([pose.centre for pose in poses])
    if file.frame is PoseFrame.LOCAL:
        return rotations
    own = frame.crs if file.crs is None else file.crs
    if (
        file.frame is PoseFrame.GRID
        and crs_difference(geo.crs.horizontal_crs(own), geo.crs.horizontal_crs(frame.crs)) is None
    ):
        return rotations @ np.swapaxes(frame.local_from_grid(centres_crs), -1, -2)
    if file.frame is PoseFrame.GRID:
        # From true east, north and up to the grid axes of the file's own crs, at its poses.
        grid = LocalFrame(own if geo.crs.has_height(own) else own.to_3d(), tuple(np.median(centres, axis=0).tolist()))
        rotations = rotations @ np.swapaxes(grid.local_from_grid(centres), -1, -2) @ grid.local_from_enu(centres)
    elif file.frame is PoseFrame.GEOCENTRIC:
        lon, lat, _ = geodetic(file, centres)
        rotations = rotations @ np.swapaxes(enu_from_geocentric(np.radians(lon), np.radians(lat)), -1, -2)
    return rotations @ np.swapaxes(frame.local_from_enu(centres_crs), -1, -2)


def poses_in_local(file: PoseFile, path: Path, frame: LocalFrame, gps_height: str) -> tuple[np.ndarray, np.ndarray]:
    """Centres (N, 3) [m] and rotations (N, 3, 3) from local of the poses of a file, all of which are on the map."""
    centres = points_in_local(file, np.array([pose.centre for pose in file.poses]).reshape(-1, 3), frame, gps_height)
    _require_on_map(file.poses, centres, path, frame.crs)
    return centres, cams_from_local(file, file.poses, frame.crs_from_local(centres), frame)


def _require_on_map(poses: Sequence[Pose], centres: np.ndarray, path: Path | None, crs: CRS) -> None:
    for pose, is_known in zip(poses, np.isfinite(centres).all(axis=1), strict=True):
        if not is_known:
            raise PosesError(
                f"the position {pose.centre.tolist()} of {pose.name} in {path} is not on the map of {crs.name}; "
                f"correct it, or crs in {FILE_NAME}"
            )


def points_in_local(file: PoseFile, points: np.ndarray, frame: LocalFrame, gps_height: str) -> np.ndarray:
    """Points (N, 3) in the frame of a poses file as (N, 3) [m], local; raises as `points_in_crs`."""
    if file.frame is PoseFrame.LOCAL or not len(points):
        return points
    return frame.local_from_crs(points_in_crs(file, points, frame.crs, gps_height))


def given_in_local(file: PoseFile, places: np.ndarray, frame: LocalFrame, gps_height: str) -> np.ndarray:
    """Positions (N, 3) in the crs of a poses file, by GPS before its adjustment, as (N, 3) [m], local.

    Their heights are of the same kind as those of the poses.
    """
    if file.frame is not PoseFrame.GEOCENTRIC or file.crs is None or geo.crs.vertical_crs(file.crs) is not None:
        return points_in_local(replace(file, frame=PoseFrame.ENU), places, frame, gps_height)
    own = MapProjection(file.crs if geo.crs.has_height(file.crs) else file.crs.to_3d())
    geocentric = geocentric_from_geodetic(*own.geodetic_from_crs(places), a=own.a, b=own.b)
    return points_in_local(file, geocentric, frame, gps_height)


@dataclass(frozen=True)
class TiePointMisfit:
    """Reprojection residuals of tie points on straight rays [px]."""

    # rms_px, median_px: Root mean square and median distance
    rms_px: float
    median_px: float
    # num_points, num_images, num_seen: Points, photographs, and places of points in photographs
    num_points: int
    num_images: int
    num_seen: int
    num_lost: int  # Places that do not count: behind their camera, or beyond the reach of its lens

    def __str__(self) -> str:
        lost = f", {self.num_lost} more behind the cameras or beyond their lenses" if self.num_lost else ""
        return (
            f"{self.rms_px:.2f} px rms, {self.median_px:.2f} px median: reprojection on straight rays, "
            f"{self.num_seen} image points of {self.num_points} points in {self.num_images} images{lost}"
        )


def reprojection(ties: FileTies, points: np.ndarray, views: Mapping[str, View]) -> TiePointMisfit | None:
    """See `TiePointMisfit`, by views as the file names them; None where it has no places of its points in these."""
    squares, num_images = np.full(len(ties.image), -1.0), 0
    order = np.argsort(ties.image, kind="stable")
    starts = np.searchsorted(ties.image[order], np.arange(len(ties.names) + 1))
    for name, start, end in zip(ties.names, starts, starts[1:], strict=False):
        rows = order[start:end]
        if name in views and len(rows):
            missed = views[name].camera.project(points[ties.point[rows]], None) - ties.pixel[rows]
            squares[rows] = (missed**2).sum(axis=1)
            num_images += 1
    seen = np.isfinite(squares) & (squares >= 0.0)
    if not seen.any():
        return None
    every = squares[order][seen[order]]
    rms, median = (float(np.sqrt(value)) for value in (every.mean(), np.median(every)))
    num_points, num_lost = len(np.unique(ties.point[seen])), int((~np.isfinite(squares)).sum())
    return TiePointMisfit(rms, median, num_points, num_images, len(every), num_lost)


def views_in_local(found: Found, file: PoseFile, poses: list[Pose]) -> tuple[LocalFrame, list[View]]:
    """The local frame of a survey with poses, and the views of some poses of the file, which have a lens.

    The frame is that of [local] where the poses are in it. Otherwise its origin lies under the middle of the cameras,
    at the height of the water, or of the lowest camera of a dry survey.
    """
    centres = np.array([pose.centre for pose in poses])
    if file.frame is PoseFrame.LOCAL:
        if found.config.local.origin is None:
            raise ValueError("poses in a local frame have no origin; expected what `place_poses` returns")
        frame = LocalFrame(found.crs, found.config.local.origin)
        local, rotations = centres, np.array([pose.cam_from_world for pose in poses])
    else:
        in_crs = points_in_crs(file, centres, found.crs, found.config.cameras.gps_height)
        known = np.isfinite(in_crs).all(axis=1)
        water, places = found.config.water, in_crs[known] if known.any() else in_crs
        ground = places[:, 2].min() if water is None else water.known_level_m / geo.crs.height_unit_m(found.crs)
        frame = frame_about(found.crs, places, ground)
        local = frame.local_from_crs(in_crs)
        _require_on_map(poses, local, found.poses_path, found.crs)
        rotations = cams_from_local(file, poses, in_crs, frame)
    views = []
    for pose, centre, rotation in zip(poses, local, rotations, strict=True):
        if pose.lens is None:
            raise ValueError(f"the pose of {pose.name} has no lens; expected what `with_lenses` returns")
        views.append(View(pose.name, found.images[pose.name], pose.lens.camera(centre, rotation), pose.lens))
    return frame, views


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
    level = round(float(start) * geo.crs.height_unit_m(frame.crs), 2)
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
    given = replace(given, refractive_index=index, **NO_MEDIUM)
    return replace(config, water=given), water_plane(frame, given), findings


def water_plane(frame: LocalFrame, given: WaterConfig) -> FlatWater:
    if given.refractive_index is None:
        raise ValueError("refractive_index is not known before its default is filled in")
    point_crs = np.array([*given.known_level_at, given.known_level_m / geo.crs.height_unit_m(frame.crs)])
    point = frame.local_from_crs(point_crs)
    if not np.isfinite(point).all():
        raise ConfigError(f"[water] level_at is {list(given.known_level_at)}, not on the map of {frame.crs.name}")
    east, north, up = frame.local_from_grid(point_crs).T
    normal = np.cross(east + given.slope_east * up, north + given.slope_north * up)
    x, y, z = point.tolist()
    slope_x, slope_y = float(-normal[0] / normal[2]), float(-normal[1] / normal[2])
    return FlatWater((x, y, z), n_water=given.refractive_index, slope_x=slope_x, slope_y=slope_y)
