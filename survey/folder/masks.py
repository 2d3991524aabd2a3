"""Masks of photographs: found by name, in a folder of their own or beside the photographs, and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from survey.display.words import named
from survey.errors import ImageError
from survey.folder.found import Found
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES
from survey.photos.images import read_mask
from survey.photos.names import MASK_ENDING
from survey.photos.opening import open_image
from survey.photos.pixels import stored_size

# Decoding the masks of thousands of photographs takes minutes: so many of them tell black from white.
_NUM_LOOKED_AT = 5
# Masks that leave out more than this of a photograph are rather the wrong way round.
_MOST_LEFT_OUT = 0.8


def with_masks(
    found: Found, views: Sequence[View], own: Path | None, assumptions: list[str], warnings: list[str]
) -> list[View]:
    """The views with their masks, by name: that of the image, IMG.png, IMG.jpg.png, or IMG_mask with any suffix.

    They are those of the folder in [images] masks; else, where there are any, of the folder that the program used that
    made the poses; else IMG_mask beside the images, where OpenDroneMap has them.

    Raises
    ------
    ImageError
        If the folder does not exist, has no mask of any view, or a mask has another size than its photograph.
    """
    given = None if found.config.images.masks is None else found.folder / found.config.images.masks
    if given is not None and not given.is_dir():
        raise ImageError(f"the mask folder {given} does not exist; correct [images] masks in survey.toml")
    masked, where = list(views), ""
    for folder in [given] if given is not None else [own, None] if own is not None else [None]:
        masked = _masked(views, folder)
        where = "beside the images" if folder is None else f"in {folder}"
        if any(view.mask_path is not None for view in masked):
            break
    without = [view.name for view in masked if view.mask_path is None]
    if len(without) == len(views):
        if given is None:
            return masked
        raise ImageError(
            f"no mask in {given} has the name of an image, expected e.g. {Path(views[0].name).stem}.png; rename them"
        )
    if given is None:
        assumptions.append(f"the masks are those {where}, of {len(views) - len(without)} images; black is left out")
    warnings += named(without, "image", "without a mask, used whole")
    _require_sizes(masked)
    warnings += _doubts(masked)
    return masked


def _masked(views: Sequence[View], folder: Path | None) -> list[View]:
    """The views with the masks in a folder, or beside the images; without one where there is none."""
    files, masked = _Files(), []
    for view in views:
        like = view.path if folder is None else folder / view.name
        names = _names_beside(like) if folder is None else _names_in_folder(like)
        mask = files.first(like.parent, names)
        masked.append(replace(view, mask_path=None if mask == view.path else mask))
    return masked


class _Files:
    """The names in folders, each listed once."""

    def __init__(self):
        self._names: dict[Path, dict[str, Path]] = {}

    def first(self, folder: Path, names: Sequence[str]) -> Path | None:
        """The first file of these names; case does not count."""
        if folder not in self._names:
            inside = sorted(folder.iterdir()) if folder.is_dir() else []
            self._names[folder] = {path.name.casefold(): path for path in inside}
        there = self._names[folder]
        return next((there[name.casefold()] for name in names if name.casefold() in there), None)


def _names_beside(image: Path) -> list[str]:
    return [f"{image.stem}{MASK_ENDING}{suffix}" for suffix in SUFFIXES]


def _names_in_folder(like: Path) -> list[str]:
    return [like.name, f"{like.name}.png", f"{like.stem}.png", *_names_beside(like)]


def _require_sizes(views: Sequence[View]) -> None:
    for view in views:
        if view.mask_path is None:
            continue
        with open_image(view.mask_path) as image:
            found, expected = stored_size(image), (view.lens.width, view.lens.height)
        if found != expected:
            raise ImageError(
                f"the mask {view.mask_path} has {found[0]} x {found[1]} pixels, expected {expected[0]} x "
                f"{expected[1]} as its photograph has; make it from the photograph as it is stored"
            )


def _doubts(views: Sequence[View]) -> list[str]:
    """A warning where masks leave out most of what they are of."""
    paths = [view.mask_path for view in views if view.mask_path is not None]
    some = np.unique(np.linspace(0, len(paths) - 1, _NUM_LOOKED_AT).astype(int))
    left_out = float(np.median([1.0 - read_mask(paths[i]).mean() for i in some]))
    if left_out <= _MOST_LEFT_OUT:
        return []
    return [
        f"masks leave out {left_out:.0%} of their photographs (median of {len(some)}): black is what is left out; if "
        "theirs is white, invert them"
    ]
