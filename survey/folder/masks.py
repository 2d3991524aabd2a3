"""Masks of photographs: found by name, in a folder of their own or beside the photographs, and checked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from survey.display.words import named
from survey.errors import ImageError
from survey.findings import Findings
from survey.folder.found import Found
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES
from survey.photos.images import is_hidden, read_mask
from survey.photos.names import MASK_ENDING, ImageNames
from survey.photos.opening import open_image
from survey.photos.pixels import stored_size

# Decoding the masks of thousands of photographs takes minutes: so many of them tell black from white.
_NUM_LOOKED_AT = 5
# Masks that leave out more than this of a photograph are rather the wrong way round.
_MOST_LEFT_OUT = 0.8


def with_masks(found: Found, views: Sequence[View], own: Path | None) -> tuple[list[View], Findings]:
    """The views with their masks, by name: that of the image, IMG.png, IMG.jpg.png, or IMG_mask with any suffix.

    Names are those of `survey.photos.names.ImageNames`: a mask is of one photograph alone.

    They are those of the folder in [images] masks; else, where there are any, of the folder that the program used that
    made the poses; else IMG_mask beside the images, where OpenDroneMap has them.

    Raises
    ------
    ImageError
        If the folder does not exist, has no mask of any view, or a mask has another size than its photograph; if a
        mask fits two photographs, or two fit one.
    """
    given = None if found.config.images.masks is None else found.folder / found.config.images.masks
    if given is not None and not given.is_dir():
        raise ImageError(f"the mask folder {given} does not exist; correct [images] masks in survey.toml")
    masked, where = list(views), ""
    for folder in [given] if given is not None else [own, None] if own is not None else [None]:
        masked = _masked(found, views, folder)
        where = "beside the images" if folder is None else f"in {folder}"
        if any(view.mask_path is not None for view in masked):
            break
    without = [view.name for view in masked if view.mask_path is None]
    if len(without) == len(views):
        if given is None:
            return masked, Findings()
        raise ImageError(
            f"no mask in {given} has the name of an image, expected e.g. {Path(views[0].name).stem}.png; rename them"
        )
    _require_sizes(masked)
    said = f"the masks are those {where}, of {len(views) - len(without)} images; black is left out"
    warnings = (*named(without, "image", "without a mask, used whole"), *_doubts(masked))
    return masked, Findings((said,) if given is None else (), warnings)


def _masked(found: Found, views: Sequence[View], folder: Path | None) -> list[View]:
    """The views with the masks in a folder, or beside the images; without one where there is none."""
    root = found.folder / found.config.images.dir if folder is None else folder
    names, masks = ImageNames(found.images), dict[str, tuple[int, Path]]()
    for path in _files(found, root, is_beside=folder is None):
        called = _called(path.relative_to(root), is_beside=folder is None)
        rank, name = next(((i, n) for i, c in enumerate(called) if (n := names.find(c, str(path)))), (0, None))
        if name is None:
            continue
        before = masks.get(name)
        if before is not None and before[0] == rank:
            raise ImageError(f"{before[1]} and {path} are both masks of {name}; remove one of them")
        if before is None or rank < before[0]:
            masks[name] = (rank, path)
    return [replace(view, mask_path=masks[view.name][1] if view.name in masks else None) for view in views]


def _files(found: Found, root: Path, *, is_beside: bool) -> list[Path]:
    """The files that may be masks, without photographs of the survey."""
    photographs = set(found.images.values())
    folders = sorted({path.parent for path in photographs})
    below = (path for folder in folders for path in folder.iterdir()) if is_beside else root.rglob("*")
    return sorted(
        path
        for path in below
        if path.suffix.lower() in SUFFIXES
        and path not in photographs
        and not is_hidden(path.relative_to(root))
        and path.is_file()
    )


def _called(mask: Path, *, is_beside: bool) -> list[str]:
    """Names of the photograph that a mask may belong to, by its path: the longest match first."""
    whole, stem = mask.as_posix(), mask.with_suffix("").as_posix()
    ending = [stem[: -len(MASK_ENDING)]] if stem.lower().endswith(MASK_ENDING) else []
    return ending if is_beside else [whole, stem, *ending]


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
    """Warning where masks leave out most of their photographs."""
    paths = [view.mask_path for view in views if view.mask_path is not None]
    some = np.unique(np.linspace(0, len(paths) - 1, _NUM_LOOKED_AT).astype(int))
    left_out = float(np.median([1.0 - read_mask(paths[i]).mean() for i in some]))
    if left_out <= _MOST_LEFT_OUT:
        return []
    return [
        f"masks leave out {left_out:.0%} of their photographs (median of {len(some)}): black is what is left out; if "
        "theirs is white, invert them"
    ]
