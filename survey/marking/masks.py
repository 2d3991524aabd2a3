"""Masks of photographs, drawn as polygons and kept where `process` looks for them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from geo.files import write_whole
from survey.errors import ImageError
from survey.folder.found import Found
from survey.folder.pairing import masks_in
from survey.photos.images import read_mask


def mask_path(found: Found, image: str) -> Path:
    """The mask of a photograph; where it has none, IMG.png in [images] masks, or else IMG_mask.png beside it."""
    given, photograph = found.config.images.masks, found.images[image]
    folder = None if given is None else found.folder / given
    beside = photograph.with_name(f"{photograph.stem}_mask.png") if folder is None else folder / f"{image}.png"
    return masks_in(found, folder).get(image, beside)


def draw(found: Found, image: str, corners: np.ndarray, *, is_used: bool) -> None:
    """Leave out a polygon (N, 2) [px] of a photograph, or use it again, and write the mask."""
    path, (width, height) = mask_path(found, image), found.headers[image].size_px
    if path.suffix.lower() != ".png":
        raise ImageError(
            f"the mask {path} is no PNG, in which alone masks are drawn: convert it, and remove {path.name}"
        )
    used = read_mask(path) if path.is_file() else np.ones((height, width), dtype=bool)
    grey = used.astype(np.uint8) * 255
    # Pixels are counted from the centre of the first; 4 bits of OpenCV's coordinates are fractions.
    outline = np.round((np.clip(corners, 0.0, [width, height]) - 0.5) * 16).astype(np.int32)
    cv2.fillPoly(grey, [outline], 255 if is_used else 0, shift=4)
    path.parent.mkdir(parents=True, exist_ok=True)
    with write_whole(path) as stream:
        stream.write(cv2.imencode(".png", grey)[1].tobytes())


def packed(found: Found, image: str) -> bytes:
    """The mask of a photograph as a PNG of black and white; one white pixel where it has none."""
    path = mask_path(found, image)
    used = read_mask(path) if path.is_file() else np.ones((1, 1), dtype=bool)
    return cv2.imencode(".png", used.astype(np.uint8) * 255)[1].tobytes()
