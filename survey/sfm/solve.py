"""From photographs to one block in a frame of its own, which `survey.sfm.placing` then places on Earth.

Rays are straight here: `survey.adjust` then adjusts the block with bent ones.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from survey.errors import FILE_NAME, PosesError
from survey.photos.exif import Exif
from survey.sfm import block as sfm_block
from survey.sfm.block import Sensor

if TYPE_CHECKING:
    import pycolmap

MIN_VIEWS = 3
_MAX_NAMED = 16
GIVE_POSES = f"give poses made elsewhere in [cameras] poses in {FILE_NAME}"


@dataclass(frozen=True)
class Free:
    """A block in a frame of its own.

    Attributes
    ----------
    block : pycolmap.Reconstruction
        Its images have the names of `aliases`.
    notes : sentences
        What was left out.
    """

    block: pycolmap.Reconstruction
    notes: tuple[str, ...]


def aliases(images: Mapping[str, Path]) -> dict[str, str]:
    """Names for pycolmap's lists of pairs: without spaces, in one folder, in the order of the images."""
    return {name: f"{i:06d}{path.suffix.lower()}" for i, (name, path) in enumerate(images.items())}


def solve(
    images: Mapping[str, Path],
    heads: Mapping[str, Exif],
    positions: Mapping[str, np.ndarray],
    focal_px: float | None,
    work: Path,
    say: Callable[[str], None],
) -> Free:
    """Solve for the poses of images, named and in order of names.

    Parameters
    ----------
    images, heads : mapping of name to Path, to Exif
    positions : mapping of name to (3,) [m]
        Of the cameras, where known, in any one frame; they select the pairs to match.
    focal_px : float or None
        Of a calibration; it is kept.
    work : Path
        An empty folder.
    say : callable
        Called with a sentence on the progress.

    Raises
    ------
    PosesError
        If fewer than three images can be placed.
    """
    alias_of = aliases(images)
    placed = {alias_of[name]: position for name, position in positions.items()}
    blocks = _blocks(images, sensors_of(heads, alias_of, focal_px), placed, work, say)
    return Free(blocks[0], tuple(left_out(blocks, alias_of)))


def sensors_of(heads: Mapping[str, Exif], alias_of: Mapping[str, str], focal_px: float | None) -> list[Sensor]:
    """The cameras that took the images: bodies with one lens at one zoom."""
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
    if placed < MIN_VIEWS:
        raise PosesError(
            f"structure from motion placed {placed} of {len(images)} images, expected at least {MIN_VIEWS}: too "
            f"little of them matches; fly with 70 % overlap over textured ground, or {GIVE_POSES}"
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
    return [f"{why}; left out: {listed(names)}"]


def listed(names: Sequence[str]) -> str:
    """The first names of a list, and how many more there are."""
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return ", ".join(names[:_MAX_NAMED]) + more
