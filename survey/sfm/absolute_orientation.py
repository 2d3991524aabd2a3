"""Absolute orientation of blocks of photographs, each by the GPS positions of its cameras or by control points.

A similarity takes a block to local; the origin is lowered to the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame, Similarity, fit_similarity, robust_similarity
from refract import PinholeCamera
from survey.display.quantities import listed
from survey.errors import ControlError, PosesError, SurveyError
from survey.photos.poses import least_track
from survey.sfm import block as sfm_block
from survey.sfm import gps_fit
from survey.sfm.control_fit import BlockControl, ControlFit, Intersections, fit_control, intersect_marks
from survey.sfm.features import CameraBody
from survey.sfm.gps import GpsPositions
from survey.sfm.solve import GIVE_POSES, FreeBlocks

if TYPE_CHECKING:
    import pycolmap


@dataclass(frozen=True)
class PlacedBlocks:
    """Blocks in one local frame."""

    blocks: tuple[pycolmap.Reconstruction, ...]  # Those that could be placed
    frame: LocalFrame
    notes: tuple[str, ...]  # sentences


# Takes a block to local, in place, and says by what; raises PosesError or ControlError if it cannot.
Placement = Callable[["pycolmap.Reconstruction"], str]


def place_by_gps(
    free: FreeBlocks,
    gps: GpsPositions,
    sensors: list[CameraBody],
    spare: BlockControl | None = None,
    attitudes: Mapping[str, np.ndarray] | None = None,
) -> PlacedBlocks:
    """Place blocks by the GPS positions of their cameras; the blocks are changed.

    ``spare`` control is for the blocks that positions cannot place, and for the roll of those on one line; attitudes
    (3, 3) are cam from local, as XMP has them.
    """
    nearby = None if spare is None else spare.in_frame(gps.frame)

    def by_positions(block: pycolmap.Reconstruction) -> str:
        trusted = _to_positions(block, gps.local)
        poses = sfm_block.poses_of(block)
        std = gps_fit.gps_std([poses[name][0] - position for name, position in trusted.items()])
        message = (
            f"{len(trusted)} GPS positions differ from it by about {std[0]:.2f} m east and north and {std[2]:.2f} m "
            "up, before the adjustment"
        )
        line = gps_fit.line_of(list(trusted.values()), float(std.max()))
        if line is None:
            return message
        # Control over an area is the better start.
        if nearby is not None and (by_control := _by_area(nearby, block)) is not None:
            return by_control
        intersections = None if nearby is None else intersect_marks(nearby, views_of_block(block))
        return f"{message}; {line.describe(len(trusted))}: {_roll(block, line, attitudes or {}, intersections)}"

    placements: list[Placement] = [by_positions]
    if spare is not None:
        placements.append(_placement_by_control(spare, gps.frame, attitudes or {}))
    placed = _place(free, placements, gps.frame, sensors)
    return replace(placed, notes=(*gps.notes, *placed.notes))


def place_by_control(
    free: FreeBlocks,
    control: BlockControl,
    sensors: list[CameraBody],
    attitudes: Mapping[str, np.ndarray] | None = None,
) -> PlacedBlocks:
    """Place blocks by control points; the blocks are changed. Attitudes are as for `place_by_gps`."""
    placement = _placement_by_control(control, control.frame, attitudes or {})
    return _place(free, [placement], control.frame, sensors)


def _placement_by_control(control: BlockControl, frame: LocalFrame, attitudes: Mapping[str, np.ndarray]) -> Placement:
    def by_control(block: pycolmap.Reconstruction) -> str:
        fit = fit_control(control if frame is control.frame else control.in_frame(frame), views_of_block(block))
        message = _onto_control(block, fit)
        if fit.line is None:
            return message
        return f"{message}; {fit.line.describe(len(fit.used))}: {_roll(block, fit.line, attitudes, None)}"

    return by_control


def _by_area(control: BlockControl, block: pycolmap.Reconstruction) -> str | None:
    """Transform a block onto control that spans an area, and describe it; None where that cannot place it."""
    try:
        fit = fit_control(control, views_of_block(block))
    except ControlError:
        return None
    return _onto_control(block, fit) if fit.line is None else None


def _onto_control(block: pycolmap.Reconstruction, fit: ControlFit) -> str:
    """Transform a block onto its control, and describe how well it fits."""
    sfm_block.transform(block, fit.similarity)
    placed = zip(fit.intersections.points, fit.intersections.places, strict=True)
    off = [fit.similarity(place) - point.local for point, place in placed if point.name in fit.used]
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    return (
        f"placed by control points alone ({listed(fit.used)}), which differ from it by about "
        f"{math.hypot(rms[0], rms[1]):.2f} m across and {rms[2]:.2f} m up, before the adjustment"
    )


def _place(
    free: FreeBlocks, placements: Sequence[Placement], frame: LocalFrame, sensors: list[CameraBody]
) -> PlacedBlocks:
    """Place each block by the first method that can; where no block can be placed, raise for the largest."""
    notes, placed, found = list(free.notes), [], []
    refusals: list[SurveyError] = []
    for block in free.blocks:
        try:
            by = _first_that_places(placements, block)
        except (PosesError, ControlError) as error:
            refusals.append(error)
            lost = list(sfm_block.poses_of(block))
            notes.append(
                f"{len(lost)} photographs form a separate block without common points, which cannot be placed: "
                f"{error}; left out: {listed(lost)}"
            )
            continue
        placed.append(block)
        found.append(f"{_found(block, sum(len(sensor.names) for sensor in sensors))}; {by}")
    if not placed:
        # Without what was said of the largest: that is raised.
        raise type(refusals[0])("; ".join([str(refusals[0]), *free.notes])) from refusals[0]
    _share_lenses(placed, sensors)
    if len(placed) > 1:
        counts = " and ".join(str(block.num_reg_images()) for block in placed)
        notes.append(
            f"the photographs fall into {len(placed)} blocks without common points, of {counts} photographs: each is "
            "placed by itself, and they are adjusted together"
        )
    return PlacedBlocks(tuple(placed), _lowered(frame, placed), (*notes, *found))


def _first_that_places(placements: Sequence[Placement], block: pycolmap.Reconstruction) -> str:
    """Result of the first method that can place a block; the error of the first, with those of others, if none can."""
    refusals: list[SurveyError] = []
    for placement in placements:
        try:
            return placement(block)
        except (PosesError, ControlError) as error:
            refusals.append(error)
    others = "".join(f"; nor can control place it: {error}" for error in refusals[1:])
    raise type(refusals[0])(f"{refusals[0]}{others}") from refusals[0]


def _share_lenses(blocks: Sequence[pycolmap.Reconstruction], sensors: Sequence[CameraBody]) -> None:
    """Give all images of a sensor the lens that the largest block with one of them has found: it is one lens."""
    for sensor in sensors:
        lens = None
        for block in blocks:
            poses = sfm_block.poses_of(block)
            for name in (name for name in sensor.names if name in poses):
                lens = sfm_block.lens_of(block, name) if lens is None else lens
                sfm_block.camera_of(block, name).params = list(lens.params)


def views_of_block(block: pycolmap.Reconstruction) -> dict[str, PinholeCamera]:
    """The cameras of a block by the names of their photographs."""
    return {name: sfm_block.lens_of(block, name).camera(*pose) for name, pose in sfm_block.poses_of(block).items()}


def _to_positions(block: pycolmap.Reconstruction, positions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Transform a block into local by the GPS positions; return those that agree with it."""
    centres = {name: centre for name, (centre, _) in sfm_block.poses_of(block).items() if name in positions}
    num = block.num_reg_images()
    if len(centres) < (least := least_track(num)):
        raise PosesError(f"{len(centres)} of {num} solved images have GPS positions, expected {least}; {GIVE_POSES}")
    ours, gps = np.array(list(centres.values())), np.array([positions[name] for name in centres])
    if num == 2:
        # Which leave the roll about their line open, and tell no wrong one.
        similarity, agree = fit_similarity(ours, gps), np.ones(num, dtype=bool)
    else:
        similarity, agree = robust_similarity(ours, gps)
    sfm_block.transform(block, similarity)
    return {name: positions[name] for name, good in zip(centres, agree, strict=True) if good}


def _roll(
    block: pycolmap.Reconstruction,
    line: gps_fit.PositionLine,
    attitudes: Mapping[str, np.ndarray],
    intersections: Intersections | None,
) -> str:
    """Roll a block about the line of its positions by attitudes, control or the ground; returns which of them."""
    poses, across = sfm_block.poses_of(block), gps_fit.LineAxes.of(line)
    with_attitude = [name for name in poses if name in attitudes]
    if with_attitude:
        ours = np.array([poses[name][1] for name in with_attitude])
        angle = gps_fit.roll_by_attitudes(across, ours, np.array([attitudes[name] for name in with_attitude]))
        by = f"the initial roll is that of the attitudes of {len(with_attitude)} photographs in XMP"
    elif intersections is not None and intersections.points:
        angle = gps_fit.roll_by_control(across, intersections.places, intersections.local)
        by = f"the initial roll is that by control ({listed([point.name for point in intersections.points])})"
    else:
        rotations = np.array([rotation for _, rotation in poses.values()])
        angle = gps_fit.roll_by_ground(across, rotations, sfm_block.points_of(block))
        by = "at the initial roll photographs look straight down across it"
    sfm_block.transform(block, across.rolled(angle))
    return by


def _lowered(frame: LocalFrame, blocks: Sequence[pycolmap.Reconstruction]) -> LocalFrame:
    """The same frame with its origin at the height of the ground; the blocks go with it."""
    unit = height_unit_m(frame.crs)
    heights = np.concatenate([sfm_block.points_of(block)[:, 2] for block in blocks])
    drop = math.floor(float(np.median(heights)) / unit)
    for block in blocks:
        sfm_block.transform(block, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -drop * unit])))
    e, n, h = frame.origin
    return LocalFrame(frame.crs, (e, n, h + drop))


def _found(block: pycolmap.Reconstruction, num: int) -> str:
    poses = sfm_block.poses_of(block)
    focals = sorted({round(sfm_block.camera_of(block, name).focal_length, 1) for name in poses})
    return (
        f"structure from motion placed {len(poses)} of {num} images with {block.num_points3D()} points, "
        f"{block.compute_mean_reprojection_error():.2f} px, focal length {', '.join(map(str, focals[:4]))} px"
    )
