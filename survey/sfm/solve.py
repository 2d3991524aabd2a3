"""Blocks of photographs, each in a frame of its own, which `survey.sfm.absolute_orientation` places on Earth.

Rays are straight here: `survey.adjust` then adjusts the block with bent ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from survey.display.quantities import listed
from survey.errors import FILE_NAME, PosesError
from survey.photos.exif import Exif
from survey.photos.poses import least_track
from survey.sfm import block as sfm_block
from survey.sfm.block import reconstruct
from survey.sfm.features import CameraBody, match_photographs
from survey.sfm.gps_fit import attitudes_of
from survey.sfm.pairs import LEAST_HEIGHT_M, Place

if TYPE_CHECKING:
    import pycolmap

# With all axes within this angle of their mean, focal length and flying height are not determined separately.
_PARALLEL_DEG = 12.0
# So near are most focal lengths in EXIF to calibrated ones.
_FOCAL_SHARE = 0.02
# The height of the cameras over a level is rounded up by steps of this factor.
_STEP = 1.1
GIVE_POSES = f"give poses made elsewhere in [cameras] poses in {FILE_NAME}"


@dataclass(frozen=True)
class Photographs:
    """Photographs for structure from motion, with prior knowledge of them."""

    # images, headers: mapping of name to Path, to Exif; in order of names
    images: Mapping[str, Path]
    headers: Mapping[str, Exif]
    # mapping of name to (3,) [m]: of the cameras, where known, in any one frame with z up; they select pairs to match
    positions: Mapping[str, np.ndarray]
    focal_px: float | None  # Of a calibration: to start from; None for those in EXIF
    ground_m: float | None = None  # Height of ground or water in that frame, about

    @property
    def places(self) -> dict[str, Place]:
        """Places of the photographs whose position is known."""
        turned, heights = attitudes_of(self.headers), self._heights()
        found = {}
        for name, position in self.positions.items():
            header = self.headers[name]
            focal = self.focal_px or header.focal_px
            spread = None if focal is None else 0.5 * max(header.size_px) / focal
            found[name] = Place(position, turned.get(name), spread, heights.get(name))
        return found

    def _heights(self) -> dict[str, float]:
        """Approximate height [m] of each camera over ground or water; empty where they are unknown."""
        up = {name: float(position[2]) for name, position in self.positions.items()}
        started = {name: height for name in up if (height := self.headers[name].above_start_m) is not None}
        known: list[dict[str, float]] = []
        if started:
            start = float(np.median([up[name] - height for name, height in started.items()]))
            known.append({name: started.get(name, own - start) for name, own in up.items()})
        if self.ground_m is not None and up:
            middle = float(np.median(list(up.values())))
            over = middle - self.ground_m
            # Rounded up, so that another level of the water asks for the same pairs.
            over = over if over < LEAST_HEIGHT_M else _STEP ** math.ceil(math.log(over, _STEP))
            known.append({name: over + own - middle for name, own in up.items()})
        # The start may lie far above the water, and positions may have another datum: the larger reaches further.
        heights = {name: max(each[name] for each in known) for name in up} if known else {}
        if not heights or np.median(list(heights.values())) < LEAST_HEIGHT_M:
            return {}
        return {name: max(height, LEAST_HEIGHT_M) for name, height in heights.items()}


@dataclass(frozen=True)
class FreeBlocks:
    """Blocks that share no images and no points; each has a frame of its own."""

    blocks: tuple[pycolmap.Reconstruction, ...]  # The largest first; their images have the names of the photographs
    notes: tuple[str, ...]  # sentences: what was left out

    @property
    def num_images(self) -> int:
        """Number of images with a pose in their block."""
        return sum(block.num_reg_images() for block in self.blocks)


def solve(photographs: Photographs, work: Path, report: Callable[[str], None]) -> FreeBlocks:
    """Solve for the poses of photographs; ``work`` is an empty folder."""
    separate = without_shared_images(_blocks(photographs, work, report))
    sensors = sensors_of(photographs.headers, photographs.focal_px)
    nominal = {name: sensor.focal_px for sensor in sensors for name in sensor.names}
    notes = [note for block in separate for note in reset_focals(block, nominal)]
    return FreeBlocks(separate, (*left_out(separate, list(photographs.images)), *notes))


def reset_focals(block: pycolmap.Reconstruction, nominal: Mapping[str, float | None]) -> list[str]:
    """Reset focal lengths that the block does not determine to those in EXIF, and adjust it with them; notes.

    The block is changed in place; ``nominal`` are focal lengths [px] in EXIF, by name in the block. Where all axes are
    parallel over flat ground, a longer focal length and a higher flight give the same images; small errors of the lens
    model, and the bend of rays at the water, then determine the result, and heights and depths scale with it.
    """
    poses = sfm_block.poses_of(block)
    axes = np.array([rotation[2] for _, rotation in poses.values()])
    mean = axes.mean(axis=0) / np.linalg.norm(axes.mean(axis=0))
    if np.degrees(np.arccos(np.clip(axes @ mean, -1.0, 1.0))).max() > _PARALLEL_DEG:
        return []
    found = {name: sfm_block.camera_of(block, name).focal_length for name in poses}
    in_exif = {name: focal for name in found if (focal := nominal[name]) is not None}
    scales = "heights and depths scale with it"
    if not in_exif:
        return [
            f"all images look the same way and EXIF has no focal length: the solved one may be wrong, and {scales}; "
            "give [cameras] focal_px if it is known"
        ]
    wrong = [name for name, focal in in_exif.items() if abs(found[name] / focal - 1.0) > _FOCAL_SHARE]
    if not wrong:
        return []
    for name in wrong:
        sfm_block.camera_of(block, name).focal_length = in_exif[name]
    sfm_block.adjust_with_focals(block)
    return [
        "all images look the same way, which does not determine focal length and flying height separately; the "
        f"focal length in EXIF, {in_exif[wrong[0]]:.0f} px, is kept instead of the solved {found[wrong[0]]:.0f} px; "
        f"{scales}, so give [cameras] focal_px if it is known better"
    ]


def sensors_of(headers: Mapping[str, Exif], focal_px: float | None) -> list[CameraBody]:
    """The cameras that took the images: bodies with one lens at one zoom."""
    groups: dict[tuple, list[str]] = {}
    for name, header in headers.items():
        lens = (header.camera, header.serial, header.size_px, header.focal_px, header.focal_warning)
        groups.setdefault(lens, []).append(name)
    return [
        CameraBody(tuple(names), size, focal_px if focal_px is not None else exif_focal)
        for (_camera, _serial, size, exif_focal, _warning), names in groups.items()
    ]


def _blocks(photographs: Photographs, work: Path, report: Callable[[str], None]) -> list[pycolmap.Reconstruction]:
    # In pycolmap's lists of pairs names have no spaces.
    alias_of = {name: f"{i:06d}{path.suffix.lower()}" for i, (name, path) in enumerate(photographs.images.items())}
    folder = work / "images"
    folder.mkdir()
    for name, alias in alias_of.items():
        (folder / alias).symlink_to(photographs.images[name].absolute())
    places = {alias_of[name]: place for name, place in photographs.places.items()}
    sensors = [
        replace(sensor, names=tuple(alias_of[name] for name in sensor.names))
        for sensor in sensors_of(photographs.headers, photographs.focal_px)
    ]
    of_pairs = match_photographs(folder, sensors, places, work, report)
    report("structure from motion: poses")
    blocks = reconstruct(of_pairs)
    placed = blocks[0].num_reg_images() if blocks else 0
    if placed < (least := least_track(len(alias_of))):
        raise PosesError(
            f"structure from motion placed {placed} of {len(alias_of)} images, expected at least {least}: too "
            "few features match; look at Light and sharpness of bathynerf check, fly with 70 % overlap over textured "
            f"ground, or {GIVE_POSES}"
        )
    name_of = {alias: name for name, alias in alias_of.items()}
    for image in (image for block in blocks for image in block.images.values()):
        image.name = name_of[image.name]
    return blocks


def without_shared_images(blocks: Sequence[pycolmap.Reconstruction]) -> tuple[pycolmap.Reconstruction, ...]:
    """The blocks without the images that a larger one has, those that keep three at least; changed in place."""
    least = least_track(max(block.num_reg_images() for block in blocks))
    taken: set[str] = set()
    separate = []
    for block in blocks:
        # And points that then one image alone sees.
        for image in [image for image in block.images.values() if image.has_pose and image.name in taken]:
            block.deregister_frame(image.frame_id)
        if block.num_reg_images() >= least:
            taken |= sfm_block.poses_of(block).keys()
            separate.append(block)
    return tuple(separate)


def left_out(blocks: Sequence[pycolmap.Reconstruction], names: Sequence[str]) -> list[str]:
    """A sentence on the images that no block has; none if they have all."""
    placed = {name for block in blocks for name in sfm_block.poses_of(block)}
    lost = [name for name in names if name not in placed]
    return [f"some images match too little; left out: {listed(lost)}"] if lost else []
