"""Features of photographs (SIFT by OpenCV), and their matches, verified by the epipolar geometry of each pair.

D. G. Lowe, Distinctive image features from scale-invariant keypoints, IJCV 60, 2004. Pixels are those of the stored
image, whatever its EXIF orientation, and the centre of the first pixel is at (0.5, 0.5).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np

from survey.photos.images import eight_bits
from survey.photos.pixels import read_rgb
from survey.sfm.settings import FEATURES_PX, SEED, solver

if TYPE_CHECKING:
    import pycolmap

# Extrema of less contrast are noise; the limit is that of pycolmap.
_CONTRAST = 0.02
# A descriptor's numbers are shares of its whole, of which a byte has so many steps.
_STEPS = 512.0
# Angle [rad] between the descriptors of a match at most, and as a share of that to the second nearest (as COLMAP).
_MOST_ANGLE, _MOST_RATIO = 0.7, 0.8


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
    """
    pixels = cv2.cvtColor(eight_bits(read_rgb(path)), cv2.COLOR_RGB2GRAY)
    whole = min(1.0, FEATURES_PX / max(pixels.shape))
    sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST, enable_precise_upscale=True)
    # The largest are kept, and most photographs have enough of them at half the size, at a quarter of the cost.
    for shrunk in (0.5 * whole, whole):
        reduced = cv2.resize(pixels, None, fx=shrunk, fy=shrunk, interpolation=cv2.INTER_AREA)
        found = sift.detect(reduced, None)
        if len(found) >= most:
            break
    # A large feature is found again from further off, and in worse photographs.
    found = sorted(found, key=lambda each: (-each.size, -each.response, each.pt))[:most]
    if not found:
        return np.zeros((0, 4), np.float32), np.zeros((0, 128), np.uint8)
    found, descriptors = sift.compute(reduced, found)
    at = (np.array([each.pt for each in found]) + 0.5) / shrunk
    size = np.array([[0.5 * each.size / shrunk, np.radians(each.angle)] for each in found])
    share = descriptors / np.maximum(descriptors.sum(axis=1, keepdims=True), 1e-9)
    rooted = np.clip(np.rint(_STEPS * np.sqrt(share)), 0, 255).astype(np.uint8)
    return np.column_stack([at, size]).astype(np.float32), rooted


@dataclass(frozen=True)
class ImageFeatures:
    """Features of an image as the database has them."""

    camera: pycolmap.Camera
    pixels: np.ndarray  # (N, 2) float32 [px]
    descriptors: np.ndarray  # (N, 128) uint8


@dataclass(frozen=True)
class PairsToMatch:
    """Pairs of images, and the features of these images by name."""

    pairs: Sequence[tuple[str, str]]
    features: Mapping[str, ImageFeatures]

    def matched(self, threads: int = 1) -> list[tuple[np.ndarray, pycolmap.TwoViewGeometry]]:
        """Matches (K, 2) uint32 of each pair, by numbers of features, and what its epipolar geometry keeps of them.

        Each pair has its own random numbers, so that threads change nothing.
        """
        with ThreadPoolExecutor(threads) as pool:
            return list(pool.map(lambda pair: _verified(*(self.features[name] for name in pair)), self.pairs))


def _verified(one: ImageFeatures, other: ImageFeatures) -> tuple[np.ndarray, pycolmap.TwoViewGeometry]:
    matches, options = mutual_matches(one.descriptors, other.descriptors), solver().TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return matches, solver().estimate_two_view_geometry(
        one.camera, one.pixels, other.camera, other.pixels, matches, options
    )


def mutual_matches(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Matches (K, 2) uint32 of descriptors (N, 128) and (M, 128) uint8 that are nearest to each other.

    Either is clearly nearer to the other than to any second one. Products of bytes of this length are whole in
    float32, so that no order of summation changes a match.
    """
    if not len(one) or not len(other):
        return np.zeros((0, 2), np.uint32)
    alike = one.astype(np.float32) @ other.astype(np.float32).T
    nearest = alike.argmax(axis=1)
    best = alike[np.arange(len(one)), nearest]
    mutual = np.flatnonzero(best >= alike.max(axis=0)[nearest])
    nearest, best = nearest[mutual], best[mutual]
    alike[mutual, nearest] = 0.0
    second = np.maximum(alike.max(axis=1)[mutual], alike.max(axis=0)[nearest])
    angle, to_second = (np.arccos(np.minimum(each / _STEPS**2, 1.0)) for each in (best, second))
    is_clear = (angle <= _MOST_ANGLE) & (angle < _MOST_RATIO * to_second)
    return np.column_stack([mutual, nearest])[is_clear].astype(np.uint32)
