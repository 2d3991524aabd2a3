"""How sure the heights of the sweep are, from the height maps alone."""

from __future__ import annotations

import cv2
import numpy as np

# Heights of single pixels disagree and bend as those about them do: a bell of this standard deviation and width [px].
_ALIKE_PX, _BELL_PX = 2.0, 17
# Views that agree so near a pixel see it, too [px].
_BESIDE_PX = 5
# Bends are those of averaged heights, over the width of the last windows [px].
_AVERAGED_PX, _AVERAGE_PX, _WIDTH_PX = 1.0, 9, 2


def std_of(height: np.ndarray, agreeing: np.ndarray, spread: np.ndarray, tolerance: float) -> np.ndarray:
    """Standard deviation (height, width) [m] of the heights of a `DepthMap`, where other views confirm them.

    What its variance is shows in two ways: as that of a mean of heights which disagree as much as those of the pixels
    around do, with waves and errors of the poses as far as views disagree by them; and as the bends of the map over the
    width of a window, which are its noise and the relief that windows flatten. Noise is in both: the larger one counts.
    Added to it is what views say that see another height there: they agree beside a pixel, and not with it.

    Parameters
    ----------
    height, agreeing, spread : (height, width)
        As `DepthMap` has them.
    tolerance : [m]
        Heights of views that differ by less agree.
    """
    views = agreeing.astype(np.float32) + 1.0
    confirmed = views > 1.0
    # The spread is a population figure.
    squares = _near(np.where(confirmed, views * spread.astype(np.float32) ** 2, 0.0))
    others = _near(views - 1.0)
    disagreement = squares / np.maximum(others, 1e-6)
    refusing = np.where(confirmed, cv2.dilate(views, np.ones((_BESIDE_PX, _BESIDE_PX))) - views, 0.0)
    # A view that does not agree differs by the tolerance at least.
    with_refusing = (squares + _near(refusing) * tolerance**2) / np.maximum(others + _near(refusing), 1e-6)
    refusal = np.maximum(with_refusing - disagreement, 0.0)
    bends = _near(np.where(confirmed, _bends(height), 0.0)) / np.maximum(_near(confirmed), 1e-6)
    return np.sqrt(for_few(views) * (np.maximum(disagreement / views, bends) + refusal / views))


def for_few(views: np.ndarray) -> np.ndarray:
    """Factor on the variance of heights on which so many photographs agree.

    What is particular to a place (a reflection, an edge that hides it) is known from those photographs alone: Student's
    law of one degree of freedom more than there are photographs.
    """
    count = np.maximum(views.astype(np.float32), 2.0)
    return (count + 1.0) / (count - 1.0)


def _near(values: np.ndarray) -> np.ndarray:
    return _bell(values.astype(np.float32), _BELL_PX, _ALIKE_PX)


def _bends(height: np.ndarray) -> np.ndarray:
    """Mean square of the second differences of heights across and down, [m^2]."""
    smooth = _bell(height.astype(np.float32), _AVERAGE_PX, _AVERAGED_PX)
    kernel = np.zeros((1, 2 * _WIDTH_PX + 1), dtype=np.float32)
    kernel[0, [0, _WIDTH_PX, -1]] = 1.0, -2.0, 1.0
    across, down = (cv2.filter2D(smooth, -1, each, borderType=cv2.BORDER_REFLECT) for each in (kernel, kernel.T))
    return 0.5 * (across * across + down * down)


def _bell(values: np.ndarray, side: int, std_px: float) -> np.ndarray:
    return cv2.GaussianBlur(values, (side, side), std_px, borderType=cv2.BORDER_REFLECT)
