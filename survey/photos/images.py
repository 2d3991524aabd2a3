"""Photographs: found, checked, decoded and made smaller."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from survey.errors import ImageError
from survey.photos.cameras import View
from survey.photos.complete import is_complete
from survey.photos.exif import SUFFIXES
from survey.photos.opening import open_image


def list_images(folder: Path, *, deep: bool = True) -> dict[str, Path]:
    """Images in a folder and, if `deep`, below it, by name: the path in the folder with forward slashes.

    Raises
    ------
    ImageError
        Where the folder does not exist or has no image.
    """
    if not folder.is_dir():
        raise ImageError(f"the image folder {folder} does not exist; make it, or correct [images] dir in survey.toml")
    below = folder.rglob("*") if deep else folder.iterdir()
    files = sorted(p for p in below if p.suffix.lower() in SUFFIXES and p.name[0] != "." and p.is_file())
    if not files:
        raise ImageError(f"no images in {folder}; expected files ending in {', '.join(SUFFIXES)}")
    return {path.relative_to(folder).as_posix(): path for path in files}


def require_complete(path: Path) -> None:
    """Raise ImageError where an image is cut off; it is decoded only where its structure does not tell."""
    if not is_complete(path):
        _decode(path, "RGB")


def load_image(view: View, *, scale: float = 1.0) -> np.ndarray:
    """The photograph as it was taken by `view.camera`.

    Parameters
    ----------
    view : View
    scale : [-]
        Below 1, pixels are averaged over their area; the result fits ``view.camera.scaled(scale)``.

    Returns
    -------
    (height, width, 3) uint8, RGB
        EXIF orientation is not applied: poses and sizes are those of the stored pixels.

    Raises
    ------
    ImageError
        Where the image is cut off, cannot be read or is not of the size of its camera.
    """
    pixels = _decode(view.path, "RGB")
    _require_size(view, pixels)
    return _shrink(pixels, view, scale)


def load_mask(view: View, *, scale: float = 1.0) -> np.ndarray | None:
    """Where the mask of the view lets `load_image` be used, (height, width) bool; None where everywhere."""
    if view.mask_path is None:
        return None
    mask = _decode(view.mask_path, "L")
    _require_size(view, mask, path=view.mask_path)
    used = mask > 0
    if used.all():
        return None
    # A pixel of the smaller image is used where all of its area is; the average is rounded in float32.
    share = _shrink(used.astype(np.float32), view, scale)
    return share > 1.0 - 1e-4


def _decode(path: Path, mode: str) -> np.ndarray:
    try:
        with open_image(path) as image:
            # Pillow would silently clip these at 255.
            if image.mode[0] in "IF":
                raise ImageError(f"{path} has pixels of kind {image.mode}, expected 8 bits per channel; convert it")
            return np.asarray(image.convert(mode))
    except ImageError:
        raise
    except (OSError, SyntaxError, ValueError) as error:
        # Errors of the disk have an errno, those of Pillow about damaged pixels have none.
        if isinstance(error, OSError) and error.errno is not None:
            raise
        raise ImageError(
            f"{path} is damaged or cut off ({error}); copy it again from the camera or remove it"
        ) from error


def _require_size(view: View, pixels: np.ndarray, *, path: Path | None = None) -> None:
    found, expected = pixels.shape[1::-1], (view.camera.width, view.camera.height)
    if found != expected:
        raise ImageError(
            f"{path or view.path} has {found[0]} x {found[1]} pixels, expected {expected[0]} x {expected[1]} as its "
            "camera has; use the images that the poses were made from"
        )


def _shrink(pixels: np.ndarray, view: View, scale: float) -> np.ndarray:
    if scale == 1.0:
        return pixels
    camera = view.camera.scaled(scale)
    return cv2.resize(pixels, (camera.width, camera.height), interpolation=cv2.INTER_AREA)
