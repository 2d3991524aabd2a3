"""Photographs: found, checked, decoded and undistorted."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np

from refract.lens import Lens
from survey.errors import ImageError
from survey.photos.cameras import View
from survey.photos.exif import SUFFIXES
from survey.photos.opening import open_image

# A complete JPEG ends with this marker, which the compressed pixels never contain.
_JPEG_END = b"\xff\xd9"


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
    """Raise ImageError where an image is cut off.

    A JPEG that ends with its end marker is complete; anything else is decoded to find out.
    """
    if path.suffix.lower() in (".jpg", ".jpeg"):
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - 64))
            if file.read().endswith(_JPEG_END):
                return
    _decode(path, "RGB")


def load_image(view: View, *, scale: float = 1.0) -> np.ndarray:
    """The photograph as `view.camera` would have taken it.

    Parameters
    ----------
    view : View
    scale : [-]
        Below 1, pixels are averaged over their area; the result fits ``view.camera.scaled(scale)``.

    Returns
    -------
    (height, width, 3) uint8, RGB
        Zero where the distorted photograph has no pixel; see `load_mask`. EXIF orientation is not applied:
        poses and sizes are those of the stored pixels.

    Raises
    ------
    ImageError
        Where the image is cut off, cannot be read or is not of the size of its camera.
    """
    pixels = _decode(view.path, "RGB")
    _require_size(view, pixels)
    if view.lens.is_distorted:
        x, y, valid = _maps(view.lens)
        pixels = cv2.remap(pixels, x, y, cv2.INTER_LANCZOS4, borderMode=cv2.BORDER_REPLICATE)
        pixels[~valid] = 0
    return _shrink(pixels, view, scale)


def load_mask(view: View, *, scale: float = 1.0) -> np.ndarray | None:
    """Where `load_image` has pixels to be used, (height, width) bool; None where all are.

    False outside the distorted photograph and where the mask of the view is black.
    """
    masks = []
    if view.lens.is_distorted:
        masks.append(_maps(view.lens)[2])
    if view.mask_path is not None:
        mask = _decode(view.mask_path, "L")
        _require_size(view, mask, path=view.mask_path)
        if view.lens.is_distorted:
            x, y, _ = _maps(view.lens)
            mask = cv2.remap(mask, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        masks.append(mask > 0)
    if not masks or all(mask.all() for mask in masks):
        return None
    # A pixel of the smaller image is used where all of its area is; the average is rounded in float32.
    share = _shrink(np.logical_and.reduce(masks).astype(np.float32), view, scale)
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
    found, expected = pixels.shape[1::-1], (view.lens.width, view.lens.height)
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


@lru_cache(maxsize=2)
def _maps(lens: Lens) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where in the photograph each pixel of the pinhole lies, in OpenCV's pixels; and whether inside."""
    fx, fy = lens.focal
    # OpenCV counts pixels from the centre of the first one, COLMAP from its corner.
    matrix = np.array([[fx, 0.0, lens["cx"] - 0.5], [0.0, fy, lens["cy"] - 0.5], [0.0, 0.0, 1.0]])
    size = (lens.width, lens.height)
    if lens.model == "OPENCV_FISHEYE":
        k = np.array([lens[name] for name in ("k1", "k2", "k3", "k4")])
        x, y = cv2.fisheye.initUndistortRectifyMap(matrix, k, np.eye(3), matrix, size, cv2.CV_32FC1)
    else:
        k = np.array([lens[name] for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")])
        x, y = cv2.initUndistortRectifyMap(matrix, k, None, matrix, size, cv2.CV_32FC1)
    inside = (x >= -0.5) & (x <= lens.width - 0.5) & (y >= -0.5) & (y <= lens.height - 0.5)
    # Beyond the range of its fit a polynomial may fold back and show the image twice, mirrored.
    (x_down, x_right), (y_down, y_right) = np.gradient(x), np.gradient(y)
    return x, y, inside & (x_right * y_down - x_down * y_right > 0.0)
