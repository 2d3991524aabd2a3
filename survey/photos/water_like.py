"""Places in photographs that look like water: large, without texture, and dark or of the colour of water.

Single signs do not identify water: dry dunes have larger areas without texture, shade on a road is bluer
(`benchmarks/water_by_colour.py`). Asphalt, bare soil and shade may look alike: places found here are only reported,
and never count as water. Clear water over a bed with texture is not found.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from survey.photos.images import eight_bits
from survey.photos.opening import open_image
from survey.photos.pixels import read_rgb

SIZE = (256, 192)
# Around a pixel of the small picture; narrower areas do not count.
_AROUND_PX = 5
# The standard deviation there over the mean; brightness over that of half of the photograph; how much brighter blue
# and green are than red, over the mean of all three.
_SMOOTH, _DARK, _CAST = 0.08, 0.85, 0.1
_BLACK = 4.0
# Share of a photograph. Of 70 real and 130 drawn ones of dry land the largest are 0.047 of what is dark and smooth and
# 0.075 of what has the cast; a lake has up to 0.20 and 0.007, Greenland's 0.09 and 0.27.
LEAST_DARK, LEAST_CAST = 0.065, 0.15
# At most so many photographs are looked at, evenly through the flight: JPEGs, which are decoded small, and others.
_MOST_JPEGS, _MOST_OTHERS = 60, 15
_JPEG = (".jpg", ".jpeg")


def look_like_water(images: Mapping[str, Path]) -> tuple[list[str], int]:
    """Names of the photographs of a sample that look as if they showed water, and the size of the sample.

    Raises
    ------
    ImageError
        Where a photograph cannot be decoded.
    """
    names = sorted(images)
    most = _MOST_JPEGS if all(path.suffix.lower() in _JPEG for path in images.values()) else _MOST_OTHERS
    sample = [names[i] for i in np.unique(np.linspace(0, len(names) - 1, most).round().astype(int))]
    return [name for name in sample if looks_like_water(_small(images[name]))], len(sample)


def looks_like_water(small: np.ndarray) -> bool:
    """Whether a picture (H, W, 3) of about `SIZE` looks as if it showed water."""
    dark, cast = water_signs(small)
    return dark > LEAST_DARK or cast > LEAST_CAST


def water_signs(small: np.ndarray) -> tuple[float, float]:
    """Share of the largest area that is dark and without texture, and of the largest that is bluer and greener."""
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32)
    mean = cv2.blur(grey, (_AROUND_PX, _AROUND_PX))
    deviation = np.sqrt(np.maximum(cv2.blur(grey**2, (_AROUND_PX, _AROUND_PX)) - mean**2, 0.0))
    smooth = deviation < _SMOOTH * np.maximum(mean, 10.0)
    red, green, blue = np.moveaxis(small.astype(np.float32), -1, 0)
    cast = 3.0 * (np.minimum(green, blue) - red) / (red + green + blue + 1.0)
    # Black are borders and masks.
    dark = (mean < _DARK * np.median(grey)) & (mean > _BLACK)
    return largest_area(smooth & dark), largest_area(cast > _CAST)


def largest_area(mask: np.ndarray, opened_px: int = _AROUND_PX) -> float:
    """Share of the largest connected area of a mask, without what is narrower than so many pixels."""
    opened = cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, np.ones((opened_px, opened_px), np.uint8))
    _, _, areas, _ = cv2.connectedComponentsWithStats(opened)
    return float(areas[1:, cv2.CC_STAT_AREA].max(initial=0)) / mask.size


def _small(path: Path) -> np.ndarray:
    """A photograph in `SIZE`, of 8 bits."""
    if path.suffix.lower() in _JPEG:
        with open_image(path) as image:
            image.draft("RGB", (2 * SIZE[0], 2 * SIZE[1]))
            pixels = np.asarray(image.convert("RGB"))
    else:
        pixels = eight_bits(read_rgb(path))
    return cv2.resize(pixels, SIZE, interpolation=cv2.INTER_AREA)
