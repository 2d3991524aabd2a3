"""Images with pixels left out, made ready for windows: small holes are closed, large ones stay.

A window with one pixel missing cannot be compared, and sparkles of the sun leave hardly a window whole. A hole that is
no more than half of its surroundings is filled with their mean: there it tells nothing, and the rest of the window is
compared. A larger one stays NaN, which matches nothing.
"""

from __future__ import annotations

import cv2
import numpy as np

# Surroundings [px], and the least share of them that has to be known; and that of the area of a smaller pixel, whose
# mean a few of many pixels tell as well.
_AROUND_PX, _KNOWN, _KNOWN_OF_AREA = 5, 0.5, 0.2
# Standard deviation of the weights of the mean [px].
_REACH_PX = 1.5


def closed(image: np.ndarray) -> np.ndarray:
    """An image (height, width) float32 with small holes of NaN filled by whole levels."""
    known = np.isfinite(image)
    if known.all():
        return image
    weight = known.astype(np.float32)
    share = cv2.blur(weight, (_AROUND_PX, _AROUND_PX), borderType=cv2.BORDER_REPLICATE)
    values, weights = (
        cv2.GaussianBlur(each, (0, 0), _REACH_PX, borderType=cv2.BORDER_REPLICATE)
        for each in (np.where(known, image, np.float32(0.0)), weight)
    )
    mean = np.rint(values / np.maximum(weights, 1e-6))
    return np.where(known, image, np.where(share >= _KNOWN, mean, np.float32(np.nan)))


def shrunk(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """An image made smaller, to a size (width, height): means of what is known of each area, NaN of hardly any."""
    known = np.isfinite(image)
    if known.all():
        return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    value, share = (
        cv2.resize(each.astype(np.float32), size, interpolation=cv2.INTER_AREA)
        for each in (np.where(known, image, np.float32(0.0)), known)
    )
    return np.where(share >= _KNOWN_OF_AREA, value / np.maximum(share, 1e-6), np.float32(np.nan))
