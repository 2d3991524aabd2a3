"""Features of photographs: SIFT by OpenCV, which takes a fifth of the time of pycolmap's, in pycolmap's form.

The centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.sfm.settings import FEATURES_PX

# Extrema of less contrast are noise; the limit is that of pycolmap.
_CONTRAST = 0.02
# A descriptor's numbers are shares of its whole, of which a byte has so many steps.
_STEPS = 512.0


def features_of(path: Path, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Features of a photograph, those of the largest scale first.

    Parameters
    ----------
    path : Path
        EXIF orientation is not applied.
    most : int
        No more than these are kept.

    Returns
    -------
    (N, 4) float32
        x, y, scale [px] and orientation [rad], in the stored photograph.
    (N, 128) uint8
        Roots of the shares (R. Arandjelovic and A. Zisserman, Three things everyone should know to improve object
        retrieval, 2012), as pycolmap has them.

    Raises
    ------
    ImageError
        If the photograph is damaged or cannot be read.
    """
    pixels = cv2.cvtColor(eight_bits(read_rgb(path)), cv2.COLOR_RGB2GRAY)
    shrunk = min(1.0, FEATURES_PX / max(pixels.shape))
    if shrunk < 1.0:
        pixels = cv2.resize(pixels, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
    sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    found = sift.detect(pixels, None)
    # A large feature is found again from further off, and in worse photographs.
    found = sorted(found, key=lambda each: (-each.size, -each.response, each.pt))[:most]
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    found, descriptors = sift.compute(pixels, found)
    at = (np.array([each.pt for each in found]) + 0.5) / shrunk
    size = np.array([[0.5 * each.size / shrunk, np.radians(each.angle)] for each in found])
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    rooted = np.clip(np.rint(_STEPS * np.sqrt(share)), 0, 255).astype(np.uint8)
    return np.column_stack([at, size]).astype(np.float32), rooted
