"""Poses and points of a file transformed to crs and local, and the reprojection error of its tie points."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from pyproj import CRS

from geo.compatibility import crs_difference
from geo.crs import (
    angular_unit_rad,
    ellipsoid,
    geodetic_crs,
    has_height,
    height_unit_m,
    horizontal_crs,
    prime_meridian_rad,
    vertical_crs,
)
from geo.frames import LocalFrame
from geo.projection import MapProjection, enu_from_geocentric, geocentric_from_geodetic, geodetic_from_geocentric
from geo.transformation import Transformation, height_scale
from survey.errors import PosesError
from survey.files.csv_table import same_unit
from survey.files.point_table import Units
from survey.photos.cameras import View
from survey.photos.poses import FileTies, Pose, PoseFile, PoseFrame
from survey.sfm.gps import area_at, height_transformer

_WGS84 = CRS("EPSG:4979")
_HEIGHTS = "the heights of the poses"


def points_in_crs(file: PoseFile, points: np.ndarray, crs: CRS, gps_height: str) -> np.ndarray:
    """Points (N, 3) in the frame of a poses file, which is not LOCAL, as (N, 3) in crs; NaN off the map.

    Geocentric heights are those of GPS: heights in crs, or above the ellipsoid, as `gps_height` says.
    """
    if file.frame is PoseFrame.GEOCENTRIC:
        return _from_geocentric(file, points, crs, gps_height)
    of_crs = Units.of(crs if file.crs is None else file.crs)
    units = Units(file.plan_unit_m, file.height_unit_m).meant(of_crs)
    fault = units.plan_fault(of_crs)
    if fault is not None:
        raise PosesError(f"the file of poses: {fault}; convert them")
    if file.crs is None:
        return points * [1.0, 1.0, units.height_factor(Units.of(crs))]
    stated, own = units.height_m, height_unit_m(file.crs) if has_height(file.crs) else None
    if stated is not None and own is not None and not same_unit(stated, own):
        raise PosesError(
            f"{_HEIGHTS} are in units of {stated:.10g} m by the name of their column, and of {own:.10g} m by the CRS "
            "of their file; correct one of them"
        )
    height = points[:, 2] * height_scale(file.crs, crs, _HEIGHTS, unit_m=units.height_m)
    if crs_difference(horizontal_crs(file.crs), horizontal_crs(crs)) is None:
        return np.column_stack([points[:, :2], height])
    transformation = Transformation.between(file.crs, crs, points)
    return np.column_stack([*transformation(points[:, 0], points[:, 1]), height])


def transformation_into_crs(file: PoseFile, crs: CRS) -> Transformation | None:
    """The transformation of the poses of a file into crs; None where they are in crs, or in a local frame."""
    places = np.array([pose.centre for pose in file.poses])
    if file.frame is PoseFrame.LOCAL or not len(places):
        return None
    if file.frame is PoseFrame.GEOCENTRIC:
        lon, lat, _ = _geodetic(file, places)
        own = geodetic_crs(_WGS84 if file.crs is None else file.crs)
        return Transformation.between(own, crs, np.degrees(np.column_stack([lon, lat])))
    return None if file.crs is None else Transformation.between(file.crs, crs, places)


def cams_from_local(file: PoseFile, poses: Sequence[Pose], centres_crs: np.ndarray, frame: LocalFrame) -> np.ndarray:
    """Rotations (N, 3, 3) of poses of a file from local, with their centres (N, 3) in crs; NaN off the map."""
    rotations = np.array([pose.cam_from_world for pose in poses])
    if file.frame is PoseFrame.LOCAL:
        return rotations
    own = horizontal_crs(frame.crs if file.crs is None else file.crs)
    if file.frame is PoseFrame.GRID and crs_difference(own, horizontal_crs(frame.crs)) is None:
        return rotations @ np.swapaxes(frame.local_from_grid(centres_crs), -1, -2)
    if file.frame is PoseFrame.GRID:
        # From true east, north and up to the grid axes of the file's own crs, at its poses.
        own, centres = frame.crs if file.crs is None else file.crs, np.array([pose.centre for pose in poses])
        grid = LocalFrame(own if has_height(own) else own.to_3d(), tuple(np.median(centres, axis=0).tolist()))
        rotations = rotations @ np.swapaxes(grid.local_from_grid(centres), -1, -2) @ grid.local_from_enu(centres)
    elif file.frame is PoseFrame.GEOCENTRIC:
        lon, lat, _ = _geodetic(file, np.array([pose.centre for pose in poses]))
        rotations = rotations @ np.swapaxes(enu_from_geocentric(lon, lat), -1, -2)
    return rotations @ np.swapaxes(frame.local_from_enu(centres_crs), -1, -2)


def poses_in_local(file: PoseFile, path: Path, frame: LocalFrame, gps_height: str) -> tuple[np.ndarray, np.ndarray]:
    """Centres (N, 3) [m] and rotations (N, 3, 3) from local of the poses of a file, all of which are on the map."""
    centres = points_in_local(file, np.array([pose.centre for pose in file.poses]).reshape(-1, 3), frame, gps_height)
    for pose, is_known in zip(file.poses, np.isfinite(centres).all(axis=1), strict=True):
        if not is_known:
            raise PosesError(
                f"the position {pose.centre.tolist()} of {pose.name} in {path} is not on the map of {frame.crs.name}; "
                "correct it, or the CRS"
            )
    return centres, cams_from_local(file, file.poses, frame.crs_from_local(centres), frame)


def points_in_local(file: PoseFile, points: np.ndarray, frame: LocalFrame, gps_height: str) -> np.ndarray:
    """Points (N, 3) in the frame of a poses file as (N, 3) [m], local; raises as `points_in_crs`."""
    if file.frame is PoseFrame.LOCAL or not len(points):
        return points
    return frame.local_from_crs(points_in_crs(file, points, frame.crs, gps_height))


def given_in_local(file: PoseFile, places: np.ndarray, frame: LocalFrame, gps_height: str) -> np.ndarray:
    """Positions (N, 3) in the crs of a poses file, by GPS before its adjustment, as (N, 3) [m], local.

    Their heights are of the same kind as those of the poses.
    """
    if file.frame is not PoseFrame.GEOCENTRIC or file.crs is None or vertical_crs(file.crs) is not None:
        return points_in_local(replace(file, frame=PoseFrame.ENU), places, frame, gps_height)
    own = MapProjection(file.crs if has_height(file.crs) else file.crs.to_3d())
    return points_in_local(
        file, geocentric_from_geodetic(*own.geodetic_from_crs(places), a=own.a, b=own.b), frame, gps_height
    )


def middle_of_geocentric(file: PoseFile) -> tuple[float, float]:
    """Longitude and latitude [deg] of the middle of geocentric poses."""
    lon, lat, _ = _geodetic(file, np.median([pose.centre for pose in file.poses], axis=0))
    return float(np.degrees(lon)), float(np.degrees(lat))


def _geodetic(file: PoseFile, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    axes = ellipsoid(_WGS84 if file.crs is None else file.crs)
    return geodetic_from_geocentric(points, a=axes.semi_major_metre, b=axes.semi_minor_metre)


def _from_geocentric(file: PoseFile, points: np.ndarray, crs: CRS, gps_height: str) -> np.ndarray:
    own = _WGS84 if file.crs is None else file.crs
    if prime_meridian_rad(own) or angular_unit_rad(own) != math.radians(1.0):
        raise PosesError(f"the poses are geocentric on {own.name}, whose degrees are not from Greenwich; export WGS 84")
    lon, lat, height = _geodetic(file, points)
    lon, lat = np.degrees(lon), np.degrees(lat)
    east, north = Transformation.between(geodetic_crs(own), crs, np.column_stack([lon, lat]))(lon, lat)
    if file.crs is not None and has_height(file.crs):
        if vertical_crs(file.crs) is not None:
            height_scale(file.crs, crs, _HEIGHTS)
        # Geocentric heights are ellipsoidal: of heights over a geoid, the program has added that.
        gps_height = "ellipsoidal"
    if gps_height == "crs":
        return np.column_stack([east, north, height / height_unit_m(crs)])
    known = np.isfinite(lon) & np.isfinite(lat)
    to_height = height_transformer(crs, area_at(lon[known], lat[known]))
    return np.column_stack([east, north, to_height.transform(lon, lat, height)[2]])


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
    squares, seen_points, num_images, lost = [], [], 0, 0
    order = np.argsort(ties.image, kind="stable")
    starts = np.searchsorted(ties.image[order], np.arange(len(ties.names) + 1))
    for number, name in enumerate(ties.names):
        rows = order[starts[number] : starts[number + 1]]
        if name not in views or not len(rows):
            continue
        missed = views[name].camera.project(points[ties.point[rows]], None) - ties.pixel[rows]
        square = (missed**2).sum(axis=1)
        known = np.isfinite(square)
        squares.append(square[known])
        seen_points.append(ties.point[rows][known])
        lost += int((~known).sum())
        num_images += 1
    if not squares or not sum(map(len, squares)):
        return None
    every = np.concatenate(squares)
    num_points = len(np.unique(np.concatenate(seen_points)))
    rms, median = (float(np.sqrt(value)) for value in (every.mean(), np.median(every)))
    return TiePointMisfit(rms, median, num_points, num_images, len(every), lost)
