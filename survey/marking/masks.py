"""Masks of photographs, drawn as polygons and kept where `process` looks for them."""

from pathlib import Path

import cv2
import numpy as np

from geo.files import write_whole
from survey.errors import ImageError
from survey.folder.found import Found
from survey.folder.pairing import masks_of
from survey.photos.images import read_mask
from survey.photos.pixels import require_pixels


def mask_path(found: Found, image: str) -> Path:
    """The mask of a photograph; where it has none, that of its name in the folder of masks, or IMG_mask.png beside it.

    Folders are those that `survey.folder.pairing.with_masks` takes masks from.
    """
    photograph = found.images[image]
    folder, masks = masks_of(found, found.images, found.own_masks)
    if folder is not None:
        return masks.get(image, folder / f"{image}.png")
    twins = [other for other in found.images.values() if other.with_suffix("") == photograph.with_suffix("")]
    name = photograph.stem if len(twins) == 1 else photograph.name
    return masks.get(image, photograph.with_name(f"{name}_mask.png"))


def draw(found: Found, image: str, corners: np.ndarray, *, is_used: bool) -> None:
    """Leave out a polygon (N, 2) [px] of a photograph, or use it again, and write the mask."""
    path, (width, height) = mask_path(found, image), found.headers[image].size_px
    if path.suffix.lower() != ".png":
        raise ImageError(
            f"the mask {path} is no PNG, in which alone masks are drawn: convert it, and remove {path.name}"
        )
    used = read_mask(path) if path.is_file() else np.ones((height, width), dtype=bool)
    remedy = "make it from the photograph as it is stored"
    require_pixels(f"the mask {path}", used.shape[::-1], (width, height), "its photograph", remedy)
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
