"""Photographs made small, and windows of them about one place of the bed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import lru_cache

import cv2
import numpy as np

from survey.photos.cameras import View
from survey.photos.images import load_image
from survey.photos.opening import damage_named, open_image
from survey.viewer.sightings import Sighting

# Longer side of a photograph that stands in its camera [px].
THUMBNAIL_PX = 160
# Side of a window of a photograph, how much it is enlarged, and windows beside each other.
WINDOW_PX, ENLARGED, _BESIDE = 48, 3, 3
# Bytes of decoded photographs that are kept for the next click.
_MOST_BYTES = 500_000_000
_LINE, _CROSS = 16, 6
_INK, _PAPER, _MARK = (34, 48, 60), (255, 255, 255), (255, 230, 0)


def thumbnail(view: View, longer_px: int = THUMBNAIL_PX) -> np.ndarray:
    """A photograph (height, width, 3) uint8 whose longer side has about so many pixels."""
    scale = min(longer_px / max(view.camera.width, view.camera.height), 1.0)
    size = max(round(view.camera.width * scale), 1), max(round(view.camera.height * scale), 1)
    with open_image(view.path) as image:
        if image.format == "JPEG":
            with damage_named(f"{view.path} is damaged or cut off"):
                # A JPEG gives an eighth of its size without the work for the rest.
                image.draft("RGB", size)
                return np.asarray(image.convert("RGB").resize(size))
    return load_image(view, scale=scale)


class Photographs:
    """Photographs at full size, the last ones that were asked for kept in memory."""

    def __init__(self, views: Sequence[View]):
        pixels = max((view.camera.width * view.camera.height for view in views), default=1)
        by_name = {view.name: view for view in views}
        self._load: Callable[[str], np.ndarray] = lru_cache(max(_MOST_BYTES // (3 * pixels), 2))(
            lambda name: load_image(by_name[name])
        )

    def window(self, sighting: Sighting, side_px: int = WINDOW_PX) -> np.ndarray:
        """The photograph (side, side, 3) uint8 about the place where it shows the point, its middle on the point."""
        # OpenCV counts from the centre of the first pixel.
        u, v = (sighting.pixel - 0.5).astype(np.float64)
        return cv2.getRectSubPix(self._load(sighting.view.name), (side_px, side_px), (float(u), float(v)))


def mosaic(windows: Sequence[np.ndarray], names: Sequence[str]) -> np.ndarray:
    """Windows (side, side, 3) of one size, enlarged, under their names and with a mark in the middle."""
    side = windows[0].shape[0] * ENLARGED
    rows = math.ceil(len(windows) / _BESIDE)
    sheet = np.full((rows * (side + _LINE), min(len(windows), _BESIDE) * side, 3), _PAPER, dtype=np.uint8)
    for number, (window, name) in enumerate(zip(windows, names, strict=True)):
        top, left = (number // _BESIDE) * (side + _LINE), (number % _BESIDE) * side
        large = cv2.resize(window, (side, side), interpolation=cv2.INTER_NEAREST)
        middle = side // 2
        for gap in (-1, 1):
            start, end = middle + gap * _CROSS, middle + 3 * gap * _CROSS
            cv2.line(large, (start, middle), (end, middle), _MARK, 1)
            cv2.line(large, (middle, start), (middle, end), _MARK, 1)
        sheet[top + _LINE : top + _LINE + side, left : left + side - 2] = large[:, :-2]
        cv2.putText(sheet, name[-20:], (left + 2, top + 12), cv2.FONT_HERSHEY_SIMPLEX, 0.38, _INK, 1, cv2.LINE_AA)
    return sheet
