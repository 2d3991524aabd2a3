"""Control points that place a survey without poses: whether they can, from their files alone."""

from __future__ import annotations

import math
from collections import Counter

import numpy as np

from geo.crs import height_unit_m, is_geographic
from geo.errors import PlaceMismatch
from geo.frames import LocalFrame
from survey.control.placing import control_in_local, require_metres
from survey.control.points import Control, ControlPoint
from survey.errors import FILE_NAME, ControlError, PosesError
from survey.folder.found import Found
from survey.names import GEO_TXT
from survey.photos.tie_points import least_track
from survey.pose_files import find_unread
from survey.settings.control import per_direction
from survey.sfm.control_fit import MIN_POINTS, line_of_control
from survey.sfm.gps import is_whole, what_is_missing
from survey.sfm.gps_fit import HOLD_THE_ROLL
from survey.sfm.marked import BlockControl

# On straight rays the bed seems higher than it is by about a quarter of its depth.
_APPARENT_SHARE = 0.3


def control_of_block(found: Found) -> BlockControl | None:
    """The control points of a survey in a local frame of their own; None where there are none."""
    if found.control is None or found.control.gathered is None:
        return None
    gathered = found.control.gathered
    given = [point for point in gathered.points if not point.is_check]
    if not given:
        return None
    e, n, h = np.median([point.place for point in given], axis=0).tolist()
    digits = 5 if is_geographic(found.crs) else 0
    try:
        frame = LocalFrame(found.crs, (round(e, digits), round(n, digits), float(math.floor(h))))
    except PlaceMismatch as error:
        raise ControlError(f"control points (first in {given[0].where}) cannot be in crs: {error}") from error
    control = control_in_local(
        gathered, frame, list(found.images), per_direction(found.control.config.std_m), marks_std_px=1.0
    )
    return None if control is None else of_block(control, frame, found)


def require_placing_control(found: Found) -> BlockControl:
    """The control of a survey without GPS positions and poses.

    Raises
    ------
    PosesError
        If there is no control.
    ControlError
        If it cannot place photographs: fewer than three points with two marks, or all on one line and nothing to tell
        the roll about it.
    """
    require_metres(() if found.control is None else found.control.points, found.crs)
    control = control_of_block(found)
    num = sum(head.lat_lon_height is not None for head in found.heads.values())
    num_whole = sum(is_whole(head.lat_lon_height) for head in found.heads.values())
    least = least_track(len(found.heads))
    told = (
        f"{found.folder} has no poses file, and {num} of {len(found.heads)} images have a GPS position in EXIF or "
        f"{GEO_TXT} ({num_whole} with a height){what_is_missing(found.heads)}, expected at least {least}"
    )
    if control is None:
        unread = "".join(f". {sentence}" for sentence in find_unread(found.folder))
        raise PosesError(
            f"{told}, or at least {MIN_POINTS} control points; name a file of poses in [cameras] poses in {FILE_NAME}, "
            f"or control points with their marks in [control] gcps{unread}"
        )
    enough = of_two_marks(control)
    if len(enough) < MIN_POINTS:
        count = Counter(mark.point for mark in control.marks)
        marks = ", ".join(f"{point.name} {count[point.name]}" for point in control.points[:10])
        raise ControlError(
            f"{told}; {len(enough)} of {len(control.points)} control points are marked in two photographs or more "
            f"(marks: {marks}), expected at least {MIN_POINTS} not on a line to place the survey without positions; "
            "mark more"
        )
    line = line_of_control(enough)
    if line is not None and not may_hold_roll(found):
        raise ControlError(f"{line.said(len(enough))}; {HOLD_THE_ROLL}")
    return control


def of_two_marks(control: BlockControl) -> list[ControlPoint]:
    """The points with two marks or more."""
    count = Counter(mark.point for mark in control.marks)
    return [point for point in control.points if count[point.name] >= 2]


def may_hold_roll(found: Found) -> bool:
    """Whether anything but positions and control may tell the roll about a line of them: level water, attitudes."""
    return found.config.water is not None or any(head.motion.gimbal_deg is not None for head in found.heads.values())


def of_block(control: Control, frame: LocalFrame, found: Found) -> BlockControl:
    """Control for structure from motion without check points, with a tolerance in height for the refraction."""
    points = tuple(point for point in control.points if not point.is_check)
    heights = np.array([point.crs[2] for point in points]) * height_unit_m(frame.crs)
    slack = np.zeros(len(points))
    if found.config.water is not None:
        level = found.config.water.level_m
        # Where nobody knows the level, the highest point may be just over it.
        slack = _APPARENT_SHARE * np.maximum((heights.max() if level is None else level) - heights, 0.0)
    return BlockControl(frame, points, control.marks, slack)
