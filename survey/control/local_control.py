"""Control and check points: checked against the camera positions, and transformed to the local frame."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pyproj import CRS

from geo.compatibility import likely_crs
from geo.crs import EARTH_RADIUS_M, height_unit_m, horizontal_unit, is_geographic, vertical_crs
from geo.frames import LocalFrame
from geo.transformation import lon_lat
from survey.control.points import Checkpoint, Control, ControlPoint, GivenPoint, Mark
from survey.control.reading import MergedControl, with_swapped_axes
from survey.display.quantities import distance_text, named
from survey.errors import ControlError

# Photographs of shallow water do not show points farther away.
_FARTHEST_M = 3000.0
# Of CRSs that fit.
_MOST_SHOWN = 3
# A height is far from the others beyond this many times their usual spread, and this length [m].
_FAR, _FAR_HEIGHT_M, _FEWEST = 10.0, 30.0, 4


def require_near(points: Sequence[GivenPoint], cameras: np.ndarray | None, crs: CRS) -> list[str]:
    """Warnings about implausible heights of points, which like the cameras (N, 3), if these are known, are in crs."""
    if not points:
        return []
    for point in points:
        east, north, _ = point.place
        message = f"{point.where}: the point {point.name} at {east:.10g}, {north:.10g}"
        is_in_degrees = not is_geographic(crs) and abs(east) <= 180.0 and abs(north) <= 90.0
        if cameras is None:
            if is_in_degrees:
                raise ControlError(_degrees(message, crs, ""))
            continue
        distance = _distance_m(np.array(point.place), cameras, crs)
        if distance <= _FARTHEST_M:
            continue
        other = with_swapped_axes(point, crs)
        if other is not None and _distance_m(np.array(other.place), cameras, crs) <= _FARTHEST_M:
            raise ControlError(
                f"{message} lies {distance_text(distance)} from the cameras, and among them with easting and northing "
                "(or longitude and latitude) swapped; swap the two columns in the file"
            )
        middle = np.median(cameras, axis=0)
        if is_in_degrees:
            raise ControlError(_degrees(message, crs, f", where the cameras are at {middle[0]:.10g}, {middle[1]:.10g}"))
        raise ControlError(
            f"{message} lies {distance_text(distance)} from the nearest camera, the cameras are at {middle[0]:.10g}, "
            f"{middle[1]:.10g} in {crs.name}; {_crs_advice(points, point, middle, crs)}"
        )
    return [] if cameras is None else _height_warnings(points, cameras, crs)


def _degrees(value: str, crs: CRS, where: str) -> str:
    return (
        f"{value} looks like longitude and latitude, expected {crs.name}{where}; convert it, or name the CRS in the "
        'first line of a gcp_list.txt ("EPSG:4326", longitude first)'
    )


def _height_warnings(points: Sequence[GivenPoint], cameras: np.ndarray, crs: CRS) -> list[str]:
    heights = np.array([point.place[2] for point in points])
    unit = height_unit_m(crs)
    above = heights > cameras[:, 2].max()
    if not above.any():
        return _far_heights(points, unit * heights)
    worst = points[int(np.argmax(heights))]
    return [
        f"{int(above.sum())} of {len(points)} control or check points lie above all cameras (highest camera "
        f"{unit * cameras[:, 2].max():.2f} m, {worst.name} {unit * worst.place[2]:.2f} m in {worst.where}); check "
        "that their heights have the vertical datum of crs"
    ]


def _far_heights(points: Sequence[GivenPoint], heights_m: np.ndarray) -> list[str]:
    """A warning that names points whose heights (N,) [m] lie far from those of all others."""
    off = np.abs(heights_m - np.median(heights_m))
    far = off > max(_FAR * float(np.median(off)), _FAR_HEIGHT_M)
    if len(points) < _FEWEST or not far.any():
        return []
    low, high = heights_m[~far].min(), heights_m[~far].max()
    parts = [
        f"{point.name} ({height:.2f} m in {point.where})"
        for point, height, is_far in zip(points, heights_m.tolist(), far.tolist(), strict=True)
        if is_far
    ]
    return named(
        parts, "control or check point", f"far from the others by its height, which are at {low:.2f} to {high:.2f} m"
    )


def _distance_m(place: np.ndarray, cameras: np.ndarray, crs: CRS) -> float:
    """Horizontal distance [m] from the nearest camera, on the map."""
    unit = horizontal_unit(crs)
    steps = (cameras[:, :2] - place[:2]) * unit
    if is_geographic(crs):
        steps *= EARTH_RADIUS_M * np.array([math.cos(float(np.median(cameras[:, 1])) * unit), 1.0])
    nearest = float(np.linalg.norm(steps, axis=1).min())
    return nearest if math.isfinite(nearest) else math.inf


def _crs_advice(points: Sequence[GivenPoint], far: GivenPoint, middle: np.ndarray, crs: CRS) -> str:
    """What to do about points far from the cameras: the CRS that they are likely in, by where they would lie."""
    stated = None if far.as_read is None else far.as_read.crs
    if stated is not None:
        return f"the file states {stated.name}: correct that, the point, or crs in survey.toml"
    file = far.where.partition(", line ")[0]
    own = np.array([point.place for point in points if point.where.startswith(file)])
    place = lon_lat(crs, middle[None, :2])[0].tolist()
    others = likely_crs(own, (place[0], place[1]), _FARTHEST_M, crs)[:_MOST_SHOWN]
    if not others:
        return "correct it, or crs in survey.toml, or state the CRS of the file (# EPSG:n in its first line)"
    codes = " or ".join(f"EPSG:{other.to_epsg()} ({other.name})" for other in others)
    vertical = vertical_crs(crs)
    heights = "" if vertical is None or vertical.to_epsg() is None else f"+{vertical.to_epsg()}"
    code = f"EPSG:{others[0].to_epsg()}"
    return (
        f"in {codes} it lies among them: if that is the CRS of the file, state it in its first line (# {code}), or "
        f'write crs = "{code}{heights}" in survey.toml'
    )


def control_in_local(
    merged: MergedControl,
    frame: LocalFrame,
    views: Sequence[str],
    std_m: tuple[float, float, float],
    marks_std_px: float,
) -> Control | None:
    """The control that views with a pose show; None where they show none of it.

    ``std_m`` is that of points whose file does not say it, east, north and up.
    """
    posed = set(views)
    marks = tuple(mark for mark in merged.marks if mark.view in posed)
    seen = {mark.point for mark in marks}
    points = []
    for point in merged.points:
        if point.name in seen:
            std = np.hypot(point.std_m or std_m, [point.datum_std_m, point.datum_std_m, 0.0])
            place = point.name, point.place, _local(point, frame)
            points.append(ControlPoint(*place, std, point.is_check, point.datum_std_m))
    return Control(tuple(points), marks, marks_std_px) if points else None


def without_pose(marks: Sequence[Mark], views: Sequence[str]) -> list[str]:
    """Names of the photographs that have marks but are not among the views."""
    return list(dict.fromkeys(mark.view for mark in marks if mark.view not in set(views)))


def checkpoints_in_local(points: Sequence[GivenPoint], frame: LocalFrame) -> tuple[Checkpoint, ...]:
    """Check points in local."""
    return tuple(Checkpoint(point.name, point.place, _local(point, frame)) for point in points)


def _local(point: GivenPoint, frame: LocalFrame) -> np.ndarray:
    local = frame.local_from_crs(np.array(point.place))
    if not np.isfinite(local).all():
        raise ControlError(
            f"{point.where}: {point.place[0]:.10g}, {point.place[1]:.10g} is not on the map of {frame.crs.name}; "
            "correct it, or the CRS of the file"
        )
    return local
