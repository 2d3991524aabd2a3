"""Relative sharpness of photographs, finest against coarser detail, and their saturated pixels.

A scene has detail of its own, so that no number says by itself that a photograph is blurred; of photographs of one bed
by one camera, one whose ratio is lower than that of the others is. Motion takes detail along its direction alone, so
that each of four directions counts by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from survey.photos.pixels import read_grey

# White, 255, less a margin for noise and JPEG [grey levels].
_WHITE = 250.0
# A photograph of which more than this share is white shows the sun, or its exposure, rather than the bed.
MOSTLY_WHITE = 0.5
# Width of the fainter rim of glint around saturated pixels, which hides the bed as well [px].
_RIM_PX = 1
# Standard deviations of the Gaussians that leave fine and coarse detail, and half the way of their differences [px].
_FINE, _COARSE = (0.7, 1), (2.8, 4)
_DIRECTIONS = ((1, 0), (0, 1), (1, 1), (1, -1))
# Squares of an image; the half with more coarse detail counts.
_SQUARE_PX = 64
# Side of the middle of an image that is used [px].
_MOST_PX = 2048
_FEWEST_PX = 16
# Least energy of coarse detail [grey levels squared], so that squares without any detail have a ratio.
_LEAST = 1e-3
# Grey levels of a photograph of one colour, with noise and JPEG, differ by less; those of one in the dark are below.
_PLAIN_STD, _BLACK = 2.0, 16.0


def saturated(grey: np.ndarray) -> np.ndarray:
    """Saturated pixels of an image (height, width) of 0 to 255, and those beside them, (height, width) bool."""
    white = (grey >= _WHITE).astype(np.uint8)
    side = 2 * _RIM_PX + 1
    return cv2.dilate(white, np.ones((side, side), np.uint8)).astype(bool) if white.any() else white.astype(bool)


@dataclass(frozen=True)
class ImageDetail:
    """Detail in a photograph, for its sharpness."""

    detail: np.ndarray  # (4,): see `detail_of`
    white: float  # [-]: share of its pixels that are white or beside white; see `saturated`
    is_plain: bool = False  # Whether it is black, as under a lens cap, or has one colour all over


def image_detail(path: Path) -> ImageDetail:
    """Detail and white of a photograph.

    Raises
    ------
    ImageError
        Where the image cannot be decoded.
    """
    grey = read_grey(path)
    is_plain = bool(np.std(grey) < _PLAIN_STD or np.quantile(grey, 0.99) < _BLACK)
    return ImageDetail(detail_of(grey), float(saturated(grey).mean()), is_plain)


def bytes_per_pixel(paths: Sequence[Path], sizes: Sequence[tuple[int, int]]) -> np.ndarray:
    """Bytes per pixel (N,) of the files of photographs: few where these show little."""
    return np.array([path.stat().st_size / (w * h) for path, (w, h) in zip(paths, sizes, strict=True)])


def detail_of(grey: np.ndarray) -> np.ndarray:
    """Ratios (4,) of fine to coarse detail along rows, columns and both diagonals; the higher, the sharper.

    Of an image (height, width) of grey levels, 0 to 255; NaN for less than 16 pixels a side.
    """
    if min(grey.shape) < _FEWEST_PX:
        return np.full(len(_DIRECTIONS), np.nan)
    top, left = (max(side - _MOST_PX, 0) // 2 for side in grey.shape)
    grey = grey[top : top + _MOST_PX, left : left + _MOST_PX].astype(np.float32)
    levels = [(cv2.GaussianBlur(grey, (0, 0), sigma), half_step) for sigma, half_step in (_FINE, _COARSE)]
    found = []
    for dx, dy in _DIRECTIONS:
        fine, coarse = (_energies(level, dx * half_step, dy * half_step) for level, half_step in levels)
        textured = coarse >= np.median(coarse)
        found.append(np.median(np.sqrt(fine[textured] / np.maximum(coarse[textured], _LEAST))))
    return np.array(found)


def relative(details: Sequence[np.ndarray]) -> np.ndarray:
    """Relative sharpness of images (N,), by `detail_of`: the worst direction over the median of all images."""
    every = np.array(details)
    return (every / np.median(every, axis=0)).min(axis=1)


def _energies(grey: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """Mean squares, by squares of the image, of differences between pixels 2 (dx, dy) apart."""
    rim, (height, width) = _COARSE[1], grey.shape
    ahead = grey[rim + dy : height - rim + dy, rim + dx : width - rim + dx]
    behind = grey[rim - dy : height - rim - dy, rim - dx : width - rim - dx]
    squared = (ahead - behind) ** 2
    side = min(_SQUARE_PX, *squared.shape)
    rows, columns = (length // side for length in squared.shape)
    parts = squared[: rows * side, : columns * side].reshape(rows, side, columns, side)
    return parts.mean(axis=(1, 3)).ravel()
