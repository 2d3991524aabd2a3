"""A block of photographs placed on Earth, by the GPS positions of its cameras or by control points.

A similarity takes the block to local; focal lengths that it does not determine are reset to EXIF; the origin is lowered
to the ground.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.similarity import Similarity, robust_similarity
from survey.errors import ControlError, PosesError
from survey.sfm import block as sfm_block
from survey.sfm.block import Sensor
from survey.sfm.control_fit import fit_control
from survey.sfm.gps import GpsPositions
from survey.sfm.gps_fit import gps_std, require_area
from survey.sfm.marked import BlockControl, Posed
from survey.sfm.solve import GIVE_POSES, MIN_VIEWS, Free, listed

if TYPE_CHECKING:
    import pycolmap

# With all axes within this angle of their mean, focal length and flying height are not determined separately.
_PARALLEL_DEG = 12.0
# Focal lengths in EXIF are within 5 % of calibrated ones, 35 mm equivalents of cropped images within 8 %.
_FOCAL_SHARE = 0.08


@dataclass(frozen=True)
class Placed:
    """A block in its local frame.

    Attributes
    ----------
    block : pycolmap.Reconstruction
    frame : LocalFrame
    notes : sentences
    """

    block: pycolmap.Reconstruction
    frame: LocalFrame
    notes: tuple[str, ...]


def place_by_gps(
    free: Free, gps: GpsPositions, alias_of: Mapping[str, str], sensors: list[Sensor], say: Callable[[str], None]
) -> Placed:
    """Place a block by the GPS positions of its cameras; the block is changed.

    Raises
    ------
    PosesError
        If they do not say how the block lies.
    """
    block, notes = free.block, [*gps.notes, *free.notes]
    positions = {alias_of[name]: position for name, position in gps.local.items()}
    say(f"structure from motion: {block.num_reg_images()} images are placed by their GPS positions")
    trusted = _to_positions(block, positions)
    _reset(block, sensors, notes)
    std = gps_std(_residuals(block, trusted))
    frame = _lowered(gps.frame, block)
    notes.append(
        f"{_found(block, len(alias_of))}; {len(trusted)} GPS positions lie about {std[0]:.2f} m east and north and "
        f"{std[2]:.2f} m up from it, before the adjustment"
    )
    return Placed(block, frame, tuple(notes))


def place_by_control(
    free: Free, control: BlockControl, alias_of: Mapping[str, str], sensors: list[Sensor], say: Callable[[str], None]
) -> Placed:
    """Place a block by control points; the block is changed.

    Parameters
    ----------
    free : Free
    control : BlockControl
        Its views have the names that are keys of `alias_of`.
    alias_of : mapping of name to name in the block
    sensors : list of Sensor
    say : callable

    Raises
    ------
    ControlError
        If the control does not say how the block lies.
    """
    block, notes = free.block, list(free.notes)
    say(f"structure from motion: {block.num_reg_images()} images are placed by {len(control.points)} control points")
    try:
        fit = fit_control(control, posed_of(block, alias_of))
    except ControlError as error:
        raise ControlError("; ".join([str(error), *free.notes])) from error
    sfm_block.transform(block, fit.similarity)
    _reset(block, sensors, notes)
    met = zip(fit.met.points, fit.met.places, strict=True)
    off = [fit.similarity(place) - point.local for point, place in met if point.name in fit.used]
    rms = np.sqrt(np.mean(np.square(off), axis=0))
    notes.append(
        f"{_found(block, len(alias_of))}; placed by control points alone ({listed(fit.used)}), which lie about "
        f"{math.hypot(rms[0], rms[1]):.2f} m across and {rms[2]:.2f} m up from it, before the adjustment"
    )
    return Placed(block, _lowered(control.frame, block), tuple(notes))


def posed_of(block: pycolmap.Reconstruction, alias_of: Mapping[str, str]) -> dict[str, Posed]:
    """The photographs of a block by their own names."""
    poses = sfm_block.poses_of(block)
    return {
        name: Posed(sfm_block.lens_of(block, alias), *poses[alias])
        for name, alias in alias_of.items()
        if alias in poses
    }


def _to_positions(block: pycolmap.Reconstruction, positions: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Take a block to local by the GPS positions; return those that agree with it."""
    centres = {alias: centre for alias, (centre, _) in sfm_block.poses_of(block).items() if alias in positions}
    if len(centres) < MIN_VIEWS:
        raise PosesError(
            f"{len(centres)} of {block.num_reg_images()} images that structure from motion placed have a GPS position, "
            f"expected at least {MIN_VIEWS}; {GIVE_POSES}"
        )
    ours, theirs = np.array(list(centres.values())), np.array([positions[alias] for alias in centres])
    similarity, agree = robust_similarity(ours, theirs)
    require_area(theirs[agree], float(gps_std(similarity(ours[agree]) - theirs[agree]).max()))
    sfm_block.transform(block, similarity)
    trusted = {alias: positions[alias] for alias, good in zip(centres, agree, strict=True) if good}
    return trusted


def _reset(block: pycolmap.Reconstruction, sensors: list[Sensor], notes: list[str]) -> None:
    reset_focals(block, {alias: sensor.focal_px for sensor in sensors for alias in sensor.names}, notes)


def reset_focals(block: pycolmap.Reconstruction, nominal: Mapping[str, float | None], notes: list[str]) -> bool:
    """Reset focal lengths that the block does not determine to those in EXIF; return whether that was done.

    Parameters
    ----------
    block : pycolmap.Reconstruction
        Changed in place.
    nominal : mapping of name to float or None
        Focal lengths [px] in EXIF, by name in the block.
    notes : list
        Added to: a sentence on the result.

    Notes
    -----
    Where all axes are parallel over flat ground, a longer focal length and a higher flight give the same images; small
    errors of the lens model then determine the result, and heights and depths scale with it.
    """
    poses = sfm_block.poses_of(block)
    axes = np.array([rotation[2] for _, rotation in poses.values()])
    mean = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    if np.degrees(np.arccos(np.clip(axes @ mean, -1.0, 1.0))).max() > _PARALLEL_DEG:
        return False
    found = {alias: sfm_block.focal_of(block, alias) for alias in poses}
    in_exif = {alias: focal for alias in found if (focal := nominal[alias]) is not None}
    wrong = [alias for alias, focal in in_exif.items() if abs(found[alias] / focal - 1.0) > _FOCAL_SHARE]
    scales = "heights and depths scale with it"
    if not in_exif:
        notes.append(
            f"all images look the same way and EXIF has no focal length: the solved one may be wrong, and {scales}; "
            "give [cameras] focal_px if it is known"
        )
    if not wrong:
        return False
    notes.append(
        "all images look the same way, which does not determine focal length and flying height separately; the "
        f"focal length in EXIF, {in_exif[wrong[0]]:.0f} px, is kept instead of the solved {found[wrong[0]]:.0f} px; "
        f"{scales}, so give [cameras] focal_px if it is known better"
    )
    for alias in wrong:
        sfm_block.set_focal(block, alias, in_exif[alias])
    return True


def _residuals(block: pycolmap.Reconstruction, positions: Mapping[str, np.ndarray]) -> np.ndarray:
    poses = sfm_block.poses_of(block)
    return np.array([poses[alias][0] - position for alias, position in positions.items()])


def _lowered(frame: LocalFrame, block: pycolmap.Reconstruction) -> LocalFrame:
    """The same frame with its origin at the height of the ground; the block goes with it."""
    unit = height_unit_m(frame.crs)
    fall = math.floor(float(np.median(sfm_block.points_of(block)[0][:, 2])) / unit)
    sfm_block.transform(block, Similarity(1.0, np.eye(3), np.array([0.0, 0.0, -fall * unit])))
    e, n, h = frame.origin
    return LocalFrame(frame.crs, (e, n, h + fall))


def _found(block: pycolmap.Reconstruction, num: int) -> str:
    poses = sfm_block.poses_of(block)
    focals = sorted({round(sfm_block.focal_of(block, alias), 1) for alias in poses})
    return (
        f"structure from motion placed {len(poses)} of {num} images with {block.num_points3D()} points, "
        f"{block.compute_mean_reprojection_error():.2f} px, focal length {', '.join(map(str, focals[:4]))} px"
    )
