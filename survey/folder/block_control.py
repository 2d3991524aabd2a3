"""Control points beside a block of structure from motion: whether they place it, and which of them it contradicts."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from geo.crs import height_unit_m, is_geographic
from geo.frames import LocalFrame
from survey.control.placing import control_in_local, require_metres
from survey.control.points import Control
from survey.display.words import named
from survey.errors import FILE_NAME, ControlError, PosesError
from survey.folder.config_control import per_direction
from survey.folder.found import Found
from survey.folder.pose_priors import PosePrior
from survey.photos.cameras import View
from survey.sfm.control_fit import MIN_POINTS, fit_control, require_spread
from survey.sfm.gps import MIN_POSITIONS, is_whole
from survey.sfm.marked import BlockControl, Met, Posed, meet

# On straight rays the bed seems higher than it is by about a quarter of its depth.
_APPARENT_SHARE = 0.3
# Further across than this, GPS without corrections cannot put a block; its heights may have any datum.
_OTHER_DATUM_M = 20.0
# A stated accuracy is not that of positions which control contradicts by more standard deviations, and by more than
# straight rays bend a block.
_MOST_STD, _BENT_SHARE = 6.0, 0.02


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
    frame = LocalFrame(found.crs, (round(e, digits), round(n, digits), float(math.floor(h))))
    control = control_in_local(
        gathered, frame, list(found.images), per_direction(found.control.config.std_m), marks_std_px=1.0
    )
    return None if control is None else _of_block(control, frame, found)


def require_placing_control(found: Found) -> BlockControl:
    """The control of a survey without GPS positions and poses.

    Raises
    ------
    PosesError
        If there is no control.
    ControlError
        If it cannot place photographs: fewer than three points with two marks, or all on one line.
    """
    control = control_of_block(found)
    num = sum(head.lat_lon_height is not None for head in found.heads.values())
    num_whole = sum(is_whole(head.lat_lon_height) for head in found.heads.values())
    told = (
        f"{found.folder} has no poses file, and {num} of {len(found.heads)} images have a GPS position in EXIF "
        f"({num_whole} with a height), expected at least {MIN_POSITIONS}"
    )
    if control is None:
        raise PosesError(
            f"{told}, or at least {MIN_POINTS} control points; name a file of poses in [cameras] poses in {FILE_NAME}, "
            "or control points with their marks in [control] gcps"
        )
    count = Counter(mark.point for mark in control.marks)
    enough = [point for point in control.points if count[point.name] >= 2]
    if len(enough) < MIN_POINTS:
        marks = ", ".join(f"{point.name} {count[point.name]}" for point in control.points[:10])
        raise ControlError(
            f"{told}; {len(enough)} of {len(control.points)} control points are marked in two photographs or more "
            f"(marks: {marks}), expected at least {MIN_POINTS} not on a line to place the survey without positions; "
            "mark more"
        )
    require_metres(found.control.points if found.control is not None else (), found.crs)
    require_spread(np.array([point.local for point in enough]), np.array([point.std for point in enough]))
    return control


def _of_block(control: Control, frame: LocalFrame, found: Found) -> BlockControl:
    """What structure from motion takes of control: no check points, and what the water hides from straight rays."""
    points = tuple(point for point in control.points if not point.is_check)
    heights = np.array([point.crs[2] for point in points]) * height_unit_m(frame.crs)
    slack = np.zeros(len(points))
    if found.config.water is not None:
        level = found.config.water.level_m
        # Where nobody knows the level, the highest point may be just over it.
        slack = _APPARENT_SHARE * np.maximum((heights.max() if level is None else level) - heights, 0.0)
    return BlockControl(frame, points, control.marks, slack)


def checked_control(
    found: Found,
    frame: LocalFrame,
    views: Sequence[View],
    control: Control,
    priors: Mapping[str, PosePrior],
    warnings: list[str],
) -> tuple[Control | None, Mapping[str, PosePrior]]:
    """Control and priors without what the block of structure from motion contradicts.

    Parameters
    ----------
    found : Found
    frame : LocalFrame
    views : of the block
    control : Control
    priors : by name of view
    warnings : list of sentences
        Added to: what is left out.

    Raises
    ------
    ControlError
        If the control fits the block nowhere, or lies elsewhere.
    """
    block = _of_block(control, frame, found)
    posed = {view.name: Posed(view.lens, view.camera.centre, view.camera.cam_from_local) for view in views}
    met = meet(block, posed)
    wrong = fit_control(block, posed).wrong if len(met.points) >= MIN_POINTS else {}
    warnings += _left_out(met, wrong)
    lost = {*met.apart, *wrong}
    points = tuple(point for point in control.points if point.name not in lost)
    bad = {(mark.point, mark.view) for mark in met.wrong_marks}
    marks = tuple(mark for mark in control.marks if mark.point not in lost and (mark.point, mark.view) not in bad)
    good = [(place, p.local, p.std) for p, place in zip(met.points, met.places, strict=True) if p.name not in lost]
    if good:
        places, theirs, stds = (np.array(column) for column in zip(*good, strict=True))
        reach, std = float(np.median(met.ranges)), np.median(stds, axis=0)
        priors = _one_datum(np.median(places - theirs, axis=0), std, reach, priors, warnings)
        priors = _without_far(views, std, reach, priors, warnings)
    return (replace(control, points=points, marks=marks) if points else None), priors


def _left_out(met: Met, wrong: Mapping[str, float]) -> list[str]:
    return [
        *named(
            [f"{mark.point} in {mark.view}" for mark in met.wrong_marks],
            "mark",
            "of control that the other marks of its point contradict, left out",
        ),
        *named(list(met.apart), "control point", "whose marks contradict each other, left out; correct the marks"),
        *named(
            [f"{name} (by {off:.2f} m)" for name, off in wrong.items()],
            "control point",
            "that the others contradict, left out; correct coordinates or name",
        ),
    ]


def _one_datum(
    common: np.ndarray, std: np.ndarray, reach: float, priors: Mapping[str, PosePrior], warnings: list[str]
) -> Mapping[str, PosePrior]:
    """The priors, without their accuracy where control says that the positions have an error in common.

    Parameters
    ----------
    common : (3,) [m]
        Control points as the positions of the cameras put them, less their coordinates.
    std, reach : (3,) [m], [m]
        Of control points; distance to the cameras.
    """
    said = (
        f"the positions of the cameras put control points {common[0]:.2f} m east, {common[1]:.2f} m north and "
        f"{common[2]:.2f} m up of their coordinates"
    )
    bent = _BENT_SHARE * reach
    if np.hypot(common[0], common[1]) > _OTHER_DATUM_M + bent + _MOST_STD * float(std[:2].max()):
        raise ControlError(f"{said}: one of both has another CRS or datum; correct crs, or the CRS of the control")
    stated = [prior.position_std for prior in priors.values() if prior.position_std is not None]
    if not stated:
        return priors
    limit = bent + _MOST_STD * np.hypot(np.median(stated, axis=0), std)
    if (np.abs(common) <= limit).all():
        return priors
    warnings.append(
        f"{said}, more than their stated accuracy explains: the block tells how good the positions are; check the base "
        "station and the datum of both"
    )
    return {name: replace(prior, position_std=None, source="GPS EXIF") for name, prior in priors.items()}


def _without_far(
    views: Sequence[View], std: np.ndarray, reach: float, priors: Mapping[str, PosePrior], warnings: list[str]
) -> Mapping[str, PosePrior]:
    """The priors without positions that lie elsewhere than where the block has the camera."""
    kept, far = dict(priors), []
    for view in views:
        prior = priors[view.name]
        if prior.position is None:
            continue
        limit = _OTHER_DATUM_M + _BENT_SHARE * reach + _MOST_STD * float(std.max())
        off = float(np.linalg.norm(prior.position - view.camera.centre))
        if off > limit:
            kept[view.name] = PosePrior(None, None, None, "none")
            far.append(f"{view.name} (by {off:.0f} m)")
    warnings += named(far, "GPS position", "that the block contradicts, left out")
    return kept
