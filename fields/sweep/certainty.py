"""How sure the heights of the sweep are, from the height maps alone."""

from __future__ import annotations

import cv2
import numpy as np

# Heights of single pixels disagree as those about them do.
_ALIKE_PX = 2.0
# Bends are those of averaged heights, over the width of the last windows [px].
_AVERAGED_PX, _WIDTH_PX = 1.0, 2
# Bells end at so many standard deviations.
_TRUNCATED = 4.0
# Filters of OpenCV take a tenth of the time of those of scipy.
_ONE = np.ones(1, dtype=np.float32)


def std_of(height: np.ndarray, agreeing: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """Standard deviation (height, width) [m] of the heights of a `DepthMap`, where other views confirm them.

    Its variance is that of a mean of heights which disagree as much as those of the pixels around do, and the square of
    the bends of the map over the width of a window, which are its noise and the relief that windows flatten. Waves and
    errors of the poses that a neighbourhood shares are in it as far as views disagree by them.
    """
    views = agreeing.astype(np.float32) + 1.0
    # The spread is a population figure.
    squares = _near(np.where(views > 1.0, views * spread.astype(np.float32) ** 2, 0.0))
    variance = squares / np.maximum(_near(views - 1.0), 1e-6)
    return np.sqrt(for_few(views) * (variance / views + _bends(height)))


def for_few(views: np.ndarray) -> np.ndarray:
    """Factor on the variance of heights on which so many photographs agree.

    What is particular to a place (a reflection, an edge that hides it) is known from those photographs alone: Student's
    law of one degree of freedom more than there are photographs.
    """
    count = np.maximum(views.astype(np.float32), 2.0)
    return (count + 1.0) / (count - 1.0)


def _near(values: np.ndarray) -> np.ndarray:
    return _blurred(values.astype(np.float32), _ALIKE_PX)


def _bends(height: np.ndarray) -> np.ndarray:
    """Mean square of the second differences of heights across and down, [m^2]."""
    smooth = _blurred(height, _AVERAGED_PX)
    kernel = np.zeros(2 * _WIDTH_PX + 1, dtype=np.float32)
    kernel[[0, _WIDTH_PX, -1]] = 1.0, -2.0, 1.0
    across, down = (_filtered(smooth, *each) for each in ((kernel, _ONE), (_ONE, kernel)))
    # Not by running sums: what they leave beside a large bend may be below zero.
    mean = np.full(3, 1.0 / 3.0, dtype=np.float32)
    return 0.5 * _filtered(across * across + down * down, mean, mean)


def _blurred(image: np.ndarray, std_px: float) -> np.ndarray:
    side = 2 * round(_TRUNCATED * std_px) + 1
    return cv2.GaussianBlur(image, (side, side), std_px, borderType=cv2.BORDER_REFLECT)


def _filtered(image: np.ndarray, across: np.ndarray, down: np.ndarray) -> np.ndarray:
    return cv2.sepFilter2D(image, -1, across, down, borderType=cv2.BORDER_REFLECT)
