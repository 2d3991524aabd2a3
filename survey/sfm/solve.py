"""Blocks of photographs, each in a frame of its own, which `survey.sfm.placing` places on Earth.

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
from survey.photos.poses import least_track
from survey.sfm import block as sfm_block
from survey.sfm.block import CameraBody

if TYPE_CHECKING:
    import pycolmap

_MAX_NAMED = 16
GIVE_POSES = f"give poses made elsewhere in [cameras] poses in {FILE_NAME}"


@dataclass(frozen=True)
class Free:
    """Blocks that share no images and no points, each in a frame of its own."""

    blocks: tuple[pycolmap.Reconstruction, ...]  # The largest first; their images have the names of `aliases`
    notes: tuple[str, ...]  # sentences: what was left out

    @property
    def num_images(self) -> int:
        """Number of images with a pose in their block."""
        return sum(block.num_reg_images() for block in self.blocks)


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
        If fewer than three images can be placed, or one of two.
    """
    alias_of = aliases(images)
    placed = {alias_of[name]: position for name, position in positions.items()}
    blocks = _blocks(images, sensors_of(heads, alias_of, focal_px), placed, work, say)
    apart = apart_of(blocks)
    return Free(apart, tuple(left_out(apart, alias_of)))


def sensors_of(heads: Mapping[str, Exif], alias_of: Mapping[str, str], focal_px: float | None) -> list[CameraBody]:
    """The cameras that took the images: bodies with one lens at one zoom."""
    groups: dict[tuple, list[str]] = {}
    for name, head in heads.items():
        lens = (head.camera, head.serial, head.size_px, head.focal_px, head.focal_doubt)
        groups.setdefault(lens, []).append(alias_of[name])
    return [
        CameraBody(tuple(names), size, focal_px if focal_px is not None else exif_focal)
        for (_camera, _serial, size, exif_focal, _doubt), names in groups.items()
    ]


def _blocks(
    images: Mapping[str, Path],
    sensors: Sequence[CameraBody],
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
    if placed < (least := least_track(len(images))):
        raise PosesError(
            f"structure from motion placed {placed} of {len(images)} images, expected at least {least}: too "
            f"few features match; fly with 70 % overlap over textured ground, or {GIVE_POSES}"
        )
    return blocks


def apart_of(blocks: Sequence[pycolmap.Reconstruction]) -> tuple[pycolmap.Reconstruction, ...]:
    """The blocks without the images that a larger one has, those that keep three at least; changed in place."""
    least = least_track(max(block.num_reg_images() for block in blocks))
    taken: set[str] = set()
    apart = []
    for block in blocks:
        sfm_block.drop_images(block, taken)
        if block.num_reg_images() >= least:
            taken |= sfm_block.poses_of(block).keys()
            apart.append(block)
    return tuple(apart)


def left_out(blocks: Sequence[pycolmap.Reconstruction], alias_of: Mapping[str, str]) -> list[str]:
    """A sentence on the images that no block has, by their own names; none if they have all."""
    placed = {alias for block in blocks for alias in sfm_block.poses_of(block)}
    names = [name for name, alias in alias_of.items() if alias not in placed]
    return [f"some images match too little; left out: {listed(names)}"] if names else []


def listed(names: Sequence[str]) -> str:
    """The first names of a list, and how many more there are."""
    more = f" and {len(names) - _MAX_NAMED} more" if len(names) > _MAX_NAMED else ""
    return ", ".join(names[:_MAX_NAMED]) + more
