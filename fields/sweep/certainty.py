"""How sure the heights of the sweep are, from the height maps alone."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

# Heights of single pixels disagree as those about them do.
_ALIKE_PX = 2.0
# Bends are those of averaged heights, over the width of the last windows [px].
_AVERAGED_PX, _WIDTH_PX = 1.0, 2


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
    return ndimage.gaussian_filter(values.astype(np.float32), _ALIKE_PX)


def _bends(height: np.ndarray) -> np.ndarray:
    """Mean square of the second differences of heights across and down, [m^2]."""
    smooth = ndimage.gaussian_filter(height, _AVERAGED_PX)
    kernel = np.zeros(2 * _WIDTH_PX + 1, dtype=np.float32)
    kernel[[0, _WIDTH_PX, -1]] = 1.0, -2.0, 1.0
    square = sum(ndimage.correlate1d(smooth, kernel, axis=axis) ** 2 for axis in (0, 1))
    # Not by running sums: what they leave beside a large bend may be below zero.
    for axis in (0, 1):
        square = ndimage.correlate1d(square, np.full(3, 1.0 / 3.0), axis=axis)
    return 0.5 * square
