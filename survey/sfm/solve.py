"""From photographs with GPS positions to one block in the local frame, with every decision noted.

The order: a block by pycolmap -> a robust similarity to the GPS positions -> focal lengths that the block does not
determine reset to EXIF. Rays are straight here: `survey.adjust` then adjusts the block with bent ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from geo.crs import height_unit_m
from geo.frames import LocalFrame
from geo.similarity import Similarity, robust_similarity
from survey.errors import FILE_NAME, PosesError
from survey.photos.exif import Exif
from survey.sfm import block as sfm_block
from survey.sfm.block import Sensor
from survey.sfm.gps import GpsPositions
from survey.sfm.gps_fit import gps_std, require_area

if TYPE_CHECKING:
    import pycolmap

_MIN_VIEWS = 3
# With all axes within this angle of their mean, focal length and flying height are not determined separately.
_PARALLEL_DEG = 12.0
# Focal lengths in EXIF are within 5 % of calibrated ones, 35 mm equivalents of cropped images within 8 %.
_FOCAL_SHARE = 0.08
_MAX_NAMED = 16
_GIVE_POSES = f"give poses made elsewhere in [cameras] poses in {FILE_NAME}"


@dataclass(frozen=True)
class Solved:
    """A block in its local frame.

    Attributes
    ----------
    block : pycolmap.Reconstruction
        Its images have the names of `aliases`.
    frame : LocalFrame
    notes : sentences
    """

    block: pycolmap.Reconstruction
    frame: LocalFrame
    notes: tuple[str, ...]


def aliases(images: Mapping[str, Path]) -> dict[str, str]:
    """Names for pycolmap's lists of pairs: without spaces, in one folder, in the order of the images."""
    return {name: f"{i:06d}{path.suffix.lower()}" for i, (name, path) in enumerate(images.items())}


def solve(
    images: Mapping[str, Path],
    heads: Mapping[str, Exif],
    gps: GpsPositions,
    focal_px: float | None,
    work: Path,
    say: Callable[[str], None],
) -> Solved:
    """Solve for the poses of images, named and in order of names.

    Parameters
    ----------
    images, heads : mapping of name to Path, to Exif
    gps : GpsPositions
    focal_px : float or None
        Of a calibration; it is kept.
    work : Path
        An empty folder.
    say : callable
        Called with a sentence on the progress.

    Raises
    ------
    PosesError
        If fewer than three images can be placed, or their positions do not say how the block lies.
    """
    alias_of = aliases(images)
    positions = {alias_of[name]: position for name, position in gps.local.items()}
    sensors = _sensors(heads, alias_of, focal_px)
    blocks = _blocks(images, sensors, positions, work, say)
    block, notes = blocks[0], [*gps.notes, *left_out(blocks, alias_of)]
    say(f"structure from motion: adjustment of {block.num_reg_images()} images to their GPS positions")
    trusted = _place(block, positions, alias_of, notes)
    nominal = {alias: sensor.focal_px for sensor in sensors for alias in sensor.names}
    reset_focals(block, nominal, notes)
    std = gps_std(_residuals(block, trusted))
    frame = _lowered(gps.frame, block)
    notes.append(_found(block, len(images), len(trusted), std))
    return Solved(block, frame, tuple(notes))


def _sensors(heads: Mapping[str, Exif], alias_of: Mapping[str, str], focal_px: float | None) -> list[Sensor]:
    groups: dict[tuple, list[str]] = {}
    for name, head in heads.items():
        groups.setdefault((head.camera, head.size_px, head.focal_px), []).append(alias_of[name])
    return [
        Sensor(tuple(names), size, focal_px if focal_px is not None else exif_focal)
        for (_camera, size, exif_focal), names in groups.items()
    ]


def _blocks(
    images: Mapping[str, Path],
    sensors: Sequence[Sensor],
    positions: Mapping[str, np.ndarray],
    work: Path,
    say: Callable[[str], None],
) -> list[pycolmap.Reconstruction]:
    folder = work / "images"
    folder.mkdir()
    for name, alias in aliases(images).items():
        (folder / alias).symlink_to(images[name].resolve())
    blocks = sfm_block.solve_block(folder, sensors, positions, work, say=say)
    placed = blocks[0].num_reg_images() if blocks else 0
    if placed < _MIN_VIEWS:
        raise PosesError(
            f"structure from motion placed {placed} of {len(images)} images, expected at least {_MIN_VIEWS}: too "
            f"little of them matches; fly with 70 % overlap over textured ground, or {_GIVE_POSES}"
        )
    return blocks


def left_out(blocks: Sequence[pycolmap.Reconstruction], alias_of: Mapping[str, str]) -> list[str]:
    """A sentence on the images that the first block does not have, by their own names; none if it has all."""
    placed = sfm_block.poses_of(blocks[0])
    names = [name for name, alias in alias_of.items() if alias not in placed]
    if not names:
        return []
    why = "some images match too little"
    if len(blocks) > 1:
        why = f"the images fall into {len(blocks)} blocks that share no points; the largest is used"
    return [f"{why}; left out: {_listed(names)}"]


def _place(
    block: pycolmap.Reconstruction, positions: Mapping[str, np.ndarray], alias_of: Mapping[str, str], notes: list[str]
) -> dict[str, np.ndarray]:
    """Take a block to local by the GPS positions; return those that agree with it."""
    centres = {alias: centre for alias, (centre, _) in sfm_block.poses_of(block).items() if alias in positions}
    if len(centres) < _MIN_VIEWS:
        raise PosesError(
            f"{len(centres)} of {block.num_reg_images()} images that structure from motion placed have a GPS position, "
            f"expected at least {_MIN_VIEWS}; {_GIVE_POSES}"
        )
    ours, theirs = np.array(list(centres.values())), np.array([positions[alias] for alias in centres])
    similarity, agree = robust_similarity(ours, theirs)
    require_area(theirs[agree], float(gps_std(similarity(ours[agree]) - theirs[agree]).max()))
    sfm_block.transform(block, similarity)
    trusted = {alias: positions[alias] for alias, good in zip(centres, agree, strict=True) if good}
    wrong = [name for name, alias in alias_of.items() if alias in centres and alias not in trusted]
    if wrong:
        notes.append(f"GPS positions that the other images contradict are not used: {_listed(wrong)}")
    return trusted


def reset_focals(block: pycolmap.Reconstruction, nominal: Mapping[str, float | None], notes: list[str]) -> bool:
    """Reset focal lengths that the block does not determine to those in EXIF; return whether that was done.

    Parameters
    ----------
    block : pycolmap.Reconstruction
        Changed in place.
    nominal : mapping of name to float or None
        Focal lengths [px] in EXIF, by name in the block.
    notes : list
        Called with a sentence on the result.

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


def _found(block: pycolmap.Reconstruction, num: int, num_gps: int, std: np.ndarray) -> str:
    poses = sfm_block.poses_of(block)
    focals = sorted({round(sfm_block.focal_of(block, alias), 1) for alias in poses})
    return (
        f"structure from motion placed {len(poses)} of {num} images with {block.num_points3D()} points, "
        f"{block.compute_mean_reprojection_error():.2f} px, focal length {', '.join(map(str, focals[:4]))} px"
        f"; {num_gps} GPS positions lie about {std[0]:.2f} m east and north and {std[2]:.2f} m up from it, before the "
        "adjustment"
    )


def _listed(names: Sequence[str]) -> str:
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return ", ".join(names[:_MAX_NAMED]) + more
