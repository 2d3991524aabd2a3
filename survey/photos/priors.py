"""Monocular depth and normals, read from files that another program made of the photographs: NPY, TIFF or PNG."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from refract import PinholeCamera
from survey.errors import ImageError

SUFFIXES = (".npy", ".tif", ".tiff", ".png")
# A normal rounded to 8 bits has a length within 1 % of one; networks that do not normalise come within this.
MAX_LENGTH_ERROR = 0.2


def read_depth_prior(path: Path, camera: PinholeCamera) -> np.ndarray:
    """Monocular depth (height, width) float32 of the photograph of a camera, in the unit of the file.

    Scale and shift are left to the fit (`fields.volume.prior_losses.relative_depth_loss`). NaN where the file has NaN,
    infinity, or, in whole numbers, 0.

    Raises
    ------
    ImageError
        If the file is missing, of another kind, not one number per pixel, not of the camera's size, or constant.
    """
    values = _read(path)
    if values.ndim == 3 and values.shape[2] == 1:
        values = values[:, :, 0]
    if values.ndim != 2:
        raise ImageError(f"{path} has the shape {values.shape}, expected one number per pixel (height, width): a depth")
    _require_size(path, values, camera)
    if values.dtype == np.uint8:
        raise ImageError(
            f"{path} has 256 steps of depth (8 bits), too few to fit; write 16 bits, or float in NPY or TIFF"
        )
    whole = np.issubdtype(values.dtype, np.integer)
    depth = values.astype(np.float32)
    depth[~np.isfinite(depth) | (whole & (values == 0))] = np.nan
    if not np.nanmax(depth, initial=-np.inf) > np.nanmin(depth, initial=np.inf):
        raise ImageError(f"{path} is constant: all of its known pixels are equal; remove it or generate it again")
    return depth


def read_normal_prior(path: Path, camera: PinholeCamera) -> np.ndarray:
    """Monocular normals (height, width, 3) float32 of the photograph of a camera, unit, local frame.

    Files hold them in camera axes, x right, y down, z forward, so that those of visible surfaces point back to the
    camera: as numbers from -1 to 1 in NPY and float TIFF, as ``(n + 1) / 2`` of the largest number in 8 or 16 bits.
    NaN where the file has NaN, zero, or in whole numbers black.

    Raises
    ------
    ImageError
        If the file is missing, of another kind, not three numbers per pixel, not of the camera's size, does not hold
        unit vectors, or most of them face away from the camera.
    """
    values = _read(path)
    if values.ndim != 3 or values.shape[2] != 3:
        raise ImageError(f"{path} has the shape {values.shape}, expected (height, width, 3): a normal per pixel")
    _require_size(path, values, camera)
    normals = values.astype(np.float64)
    if np.issubdtype(values.dtype, np.integer):
        normals = np.where(
            (values == 0).all(axis=2, keepdims=True), np.nan, 2.0 * normals / np.iinfo(values.dtype).max - 1.0
        )
    length = np.linalg.norm(normals, axis=2)
    known = np.isfinite(length) & (length > 0.0)
    if not known.any():
        raise ImageError(f"{path} has no normals: all of its pixels are zero or NaN; remove it or generate it again")
    middle = float(np.median(length[known]))
    if abs(middle - 1.0) > MAX_LENGTH_ERROR:
        raise ImageError(
            f"{path} has vectors of length {middle:.2f}, expected 1; store normals from -1 to 1 in float, or as "
            "(n + 1) / 2 of the largest number in whole numbers"
        )
    local = normals / np.where(known, length, np.nan)[..., None] @ camera.cam_from_local
    away = (local * camera.directions(camera.pixel_centres())).sum(axis=2)[known] > 0.0
    if away.mean() > 0.5:
        raise ImageError(
            f"{away.mean():.0%} of the normals in {path} face away from the camera; expected axes x right, y down, z "
            "forward. If the file has y up and z back, change the sign of both"
        )
    return local.astype(np.float32)


def _read(path: Path) -> np.ndarray:
    if path.suffix.lower() not in SUFFIXES:
        raise ImageError(f"{path} is of an unknown kind; expected a file ending in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise ImageError(f"the prior {path} does not exist; generate it, or correct its path")
    if path.suffix.lower() == ".npy":
        try:
            values = np.load(path, allow_pickle=False)
        except (ValueError, EOFError) as error:
            raise ImageError(
                f"{path} is not an array that numpy can read ({error}); save it with numpy.save"
            ) from error
        if values.dtype.kind not in "uif":
            raise ImageError(f"{path} holds {values.dtype}, expected real numbers")
        return values
    values = cv2.imdecode(np.fromfile(path, dtype=np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise ImageError(f"{path} is not an image that can be read; generate it again")
    return values[:, :, ::-1] if values.ndim == 3 and values.shape[2] == 3 else values


def _require_size(path: Path, values: np.ndarray, camera: PinholeCamera) -> None:
    height, width = values.shape[:2]
    if (height, width) != (camera.height, camera.width):
        raise ImageError(
            f"{path} has {width} x {height} px, its camera {camera.width} x {camera.height} px; a prior has the "
            "size of the photograph, at the scale of the training"
        )
