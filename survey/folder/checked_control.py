"""Control points that place a survey without poses, tested against the block of structure from motion."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from geo.crs import height_unit_m
from geo.errors import PlaceMismatch
from geo.frames import LocalFrame, Similarity
from survey.control.points import Control, ControlPoint, Mark
from survey.control.reading import require_near
from survey.display.quantities import named
from survey.errors import FILE_NAME, ControlError, Findings, PosesError
from survey.folder.control import control_in_local
from survey.folder.found import Found
from survey.folder.observations import PlacedViews
from survey.folder.pose_priors import GPS_STD_M, PosePrior
from survey.photos.cameras import View
from survey.photos.poses import connected_parts, least_track
from survey.pose_files import find_unread
from survey.sfm import control_fit
from survey.sfm.gps import frame_about, is_whole, what_is_missing
from survey.sfm.gps_fit import ROLL_REMEDY
from survey.words import GEO_TXT

# On straight rays the bed seems higher than it is by about a quarter of its depth.
_APPARENT_SHARE = 0.3
# GPS without corrections is never this far off in plan; its heights may have any datum.
_OTHER_DATUM_M = 20.0
# The stated accuracy of positions is rejected where control contradicts them by more standard deviations than this, and
# by more than straight rays deform a block, as a share of its size.
_MOST_STD, _BENT_SHARE = 6.0, 0.02
# With fewer positions than this the adjustment cannot tell which one is wrong.
_FEWEST_TO_TEST = 4


def control_of_block(found: Found) -> control_fit.BlockControl | None:
    """The control points of a survey in a local frame of their own; None where there are none."""
    given = found.control.given
    if not given:
        return None
    try:
        frame = frame_about(found.crs, [point.place for point in given])
    except PlaceMismatch as error:
        raise ControlError(f"control points (first in {given[0].where}) cannot be in crs: {error}") from error
    control = control_in_local(found.control, frame, list(found.images))
    return None if control is None else _for_block(control, frame, found)


def require_placing_control(found: Found) -> control_fit.BlockControl:
    """The control of a survey without GPS positions and poses."""
    require_near(found.control.points, None, found.crs)
    control = control_of_block(found)
    num = sum(header.lat_lon_height is not None for header in found.headers.values())
    num_whole = sum(is_whole(header.lat_lon_height) for header in found.headers.values())
    least = least_track(len(found.headers))
    message = (
        f"{found.folder} has no poses file, and {num} of {len(found.headers)} images have a GPS position in EXIF or "
        f"{GEO_TXT} ({num_whole} with a height){what_is_missing(found.headers)}, expected at least {least}"
    )
    if control is None:
        unread = "".join(f". {sentence}" for sentence in find_unread(found.folder))
        raise PosesError(
            f"{message}, or at least {control_fit.MIN_POINTS} control points; name a file of poses in [cameras] poses "
            f"in {FILE_NAME}, or control points with their marks in [control] gcps{unread}"
        )
    enough = with_two_marks(control)
    if len(enough) < control_fit.MIN_POINTS:
        count = Counter(mark.point for mark in control.marks)
        marks = ", ".join(f"{point.name} {count[point.name]}" for point in control.points[:10])
        raise ControlError(
            f"{message}; {len(enough)} of {len(control.points)} control points are marked in two photographs or more "
            f"(marks: {marks}), expected at least {control_fit.MIN_POINTS} not on a line; mark more"
        )
    line = control_fit.line_of_control(enough)
    if line is not None and not may_hold_roll(found):
        raise ControlError(f"{line.describe(len(enough))}; {ROLL_REMEDY}")
    return control


def with_two_marks(control: control_fit.BlockControl) -> list[ControlPoint]:
    count = Counter(mark.point for mark in control.marks)
    return [point for point in control.points if count[point.name] >= 2]


def may_hold_roll(found: Found) -> bool:
    """Whether level water or attitudes may determine the roll about a line of positions or control points."""
    return found.config.water is not None or any(
        header.motion.gimbal_deg is not None for header in found.headers.values()
    )


def _for_block(control: Control, frame: LocalFrame, found: Found) -> control_fit.BlockControl:
    """Control for structure from motion without check points, with a tolerance in height for the refraction."""
    points = tuple(point for point in control.points if not point.is_check)
    heights = np.array([point.crs[2] for point in points]) * height_unit_m(frame.crs)
    slack = np.zeros(len(points))
    if found.config.water is not None:
        level = found.config.water.level_m
        # Where the level is unknown, the highest point may be just above it.
        slack = _APPARENT_SHARE * np.maximum((heights.max() if level is None else level) - heights, 0.0)
    return control_fit.BlockControl(frame, points, control.marks, slack)


def checked_parts(block: PlacedViews) -> tuple[PlacedViews, Findings]:
    """The block with its control tested against each of its parts by itself, and moved to it where it has to be.

    Parts share no points: each has a place, a tilt and a scale of its own.
    """
    views, seen = list(block.views), block.observations
    ties, control = seen.ties, seen.control
    if control is None or ties is None:
        return block, Findings()
    # Views that share no point with two others have no part of their own.
    part = np.maximum(connected_parts(len(views), ties.point, ties.view), 0)
    priors, marks, findings = dict(seen.priors), set[Mark](), Findings()
    refusals: list[ControlError] = []
    for number in range(int(part.max()) + 1):
        members = [views[k] for k in np.flatnonzero(part == number)]
        names = {view.name for view in members}
        own = _with_marks(control, [mark for mark in control.marks if mark.view in names])
        if own is None:
            continue
        own_priors = {name: prior for name, prior in priors.items() if name in names}
        try:
            kept, tested, move, added = _checked(block.found, block.frame, members, own, own_priors)
        except ControlError as error:
            refusals.append(error)
            continue
        findings += added
        priors |= tested
        marks |= set() if kept is None else set(kept.marks)
        if move is not None:
            is_moved = np.zeros(len(ties), dtype=bool)
            is_moved[ties.point] = part[ties.view] == number
            ties = replace(ties, start=np.where(is_moved[:, None], move(ties.start), ties.start))
            for k in np.flatnonzero(part == number):
                pose = move(views[k].camera.centre), views[k].camera.cam_from_local @ move.rotation.T
                views[k] = replace(views[k], camera=views[k].lens.camera(*pose))
    if refusals and not marks:
        raise refusals[0]
    what = "control of a part of the photographs that shares no points with the others"
    findings += Findings(warnings=tuple(f"{what}: {error}" for error in refusals))
    left = _with_marks(control, [mark for mark in control.marks if mark in marks])
    seen = replace(seen, points=ties.start, ties=ties, control=left, priors=priors)
    return replace(block, views=views, observations=seen), findings


def _with_marks(control: Control, marks: list[Mark]) -> Control | None:
    """Control with some of its marks and their points; None without any."""
    names = {mark.point for mark in marks}
    points = tuple(point for point in control.points if point.name in names)
    return replace(control, points=points, marks=tuple(marks)) if points else None


def _checked(
    found: Found, frame: LocalFrame, views: Sequence[View], control: Control, priors: Mapping[str, PosePrior]
) -> tuple[Control | None, Mapping[str, PosePrior], Similarity | None, Findings]:
    """Control and priors without contradicted ones, which warnings name, and what moves the block to its control."""
    block = _for_block(control, frame, found)
    posed = {view.name: view.camera for view in views}
    seen = control_fit.intersect_marks(block, posed)
    control_fit.require_consistent_marks(block, posed, seen)
    fit = None
    if len(seen.points) >= control_fit.MIN_POINTS:
        # On one line points determine no similarity by themselves.
        _, across, least = control_fit.spread_of(seen.local, seen.std)
        fit = control_fit.fit_majority(seen, posed) if across >= least else None
    wrong = {} if fit is None else fit.wrong
    warnings = named(
        [f"{mark.point} in {mark.view}" for mark in seen.wrong_marks],
        "mark",
        "of control that the other marks of its point contradict, left out",
    )
    warnings += named(
        list(seen.inconsistent), "control point", "whose marks contradict each other, left out; correct the marks"
    )
    warnings += named(
        [f"{name} (by {off:.2f} m)" for name, off in wrong.items()],
        "control point",
        "that the others contradict, left out; correct coordinates or name",
    )
    lost = {*seen.inconsistent, *wrong}
    bad = {(mark.point, mark.view) for mark in seen.wrong_marks}
    marks = [mark for mark in control.marks if mark.point not in lost and (mark.point, mark.view) not in bad]
    good, move = [i for i, point in enumerate(seen.points) if point.name not in lost], None
    if good:
        common = np.median([seen.places[i] - seen.points[i].local for i in good], axis=0)
        reach, std = float(np.median(seen.ranges)), np.median([seen.points[i].std for i in good], axis=0)
        other_datum = _other_datum(common, std, reach, priors)
        if other_datum is not None:
            warnings.append(other_datum)
            move = None if fit is None else fit.similarity
            priors = {
                name: replace(prior, position_std=None, source="none" if prior.position is None else "GPS EXIF")
                for name, prior in priors.items()
            }
        elif sum(prior.position is not None for prior in priors.values()) < _FEWEST_TO_TEST:
            priors, far = _without_far(views, std, reach, priors)
            warnings += far
    return _with_marks(control, marks), priors, move, Findings(warnings=tuple(warnings))


def _other_datum(common: np.ndarray, std: np.ndarray, reach: float, priors: Mapping[str, PosePrior]) -> str | None:
    """A warning where control and positions do not agree; None where they do.

    ``common`` (3,) [m] is control as intersected by means of the camera positions, minus its coordinates; ``std`` (3,)
    [m] is that of control points, ``reach`` [m] their distance to the cameras.
    """
    message = (
        f"the positions of the cameras put control points {common[0]:.2f} m east, {common[1]:.2f} m north and "
        f"{common[2]:.2f} m up of their coordinates"
    )
    bent = _BENT_SHARE * reach
    if np.hypot(common[0], common[1]) > _OTHER_DATUM_M + bent + _MOST_STD * float(std[:2].max()):
        raise ControlError(f"{message}: one of both has another CRS or datum; correct crs, or the CRS of the control")
    stated = [prior.position_std for prior in priors.values() if prior.position_std is not None]
    position_std = np.median(stated, axis=0) if stated else np.full(3, GPS_STD_M)
    if (np.abs(common) <= bent + _MOST_STD * np.hypot(position_std, std)).all():
        return None
    return (
        f"{message}, more than their stated accuracies allow: the block is fitted to the control, and the accuracy of "
        "the positions is estimated; check the base station, and the datum of the heights"
    )


def _without_far(
    views: Sequence[View], std: np.ndarray, reach: float, priors: Mapping[str, PosePrior]
) -> tuple[Mapping[str, PosePrior], list[str]]:
    """The priors without positions that the block contradicts, and a warning that names these."""
    kept, far = dict(priors), []
    for view in views:
        prior = priors[view.name]
        if prior.position is None:
            continue
        accuracy = np.full(3, GPS_STD_M) if prior.position_std is None else prior.position_std
        # Cameras hang over their control by its tilt.
        limit = 2.0 * _BENT_SHARE * reach + _MOST_STD * float(np.hypot(accuracy, std).max())
        off = float(np.linalg.norm(prior.position - view.camera.centre))
        if off > limit:
            kept[view.name] = prior.without_position()
            far.append(f"{view.name} (by {off:.0f} m)")
    return kept, named(
        far, "GPS position", "that the block contradicts on straight rays, left out before the adjustment"
    )
