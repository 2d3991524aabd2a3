"""Standard deviation of the heights of the sweep, from the height maps alone."""

from __future__ import annotations

import cv2
import numpy as np

# Disagreement and second differences are averaged by a Gauss filter of this standard deviation and width [px].
_LOCAL_STD_PX, _LOCAL_PX = 2.0, 17
# Views that agree within this distance of a pixel see it, too [px].
_NEAR_PX = 5
# Second differences are those of smoothed heights, over the width of the last windows [px].
_AVERAGED_PX, _AVERAGE_PX, _WIDTH_PX = 1.0, 9, 2


def height_std(
    height: np.ndarray,
    agreeing: np.ndarray,
    spread: np.ndarray,
    tolerance: float,
    num_comparable: np.ndarray | None = None,
) -> np.ndarray:
    """Standard deviation (height, width) [m] of the heights of a `HeightMap`, where other views confirm them.

    The variance has two estimates: that of a mean of heights, from their disagreement around the pixel (with waves and
    errors of the poses as far as views disagree by them); and the squared second differences of the map over the width
    of a window, which are its noise and the relief that windows flatten. Noise is in both: the larger one counts. Added
    is the disagreement of views that see another height there: they agree near the pixel, but not with it.

    Parameters
    ----------
    height, agreeing, spread : (height, width)
        As `HeightMap` has them.
    tolerance : [m]
        Heights of views that differ by less agree.
    num_comparable : (height, width), optional
        Number of views that may see another height there; by default all. A photograph that is masked or white there
        shows none (`fields.sweep.fusion.num_comparable`).
    """
    views = agreeing.astype(np.float32) + 1.0
    confirmed = views > 1.0
    # The spread is a population figure.
    squares = _local_mean(np.where(confirmed, views * spread.astype(np.float32) ** 2, 0.0))
    others = _local_mean(views - 1.0)
    disagreement = squares / np.maximum(others, 1e-6)
    dissenting = np.where(confirmed, cv2.dilate(views, np.ones((_NEAR_PX, _NEAR_PX))) - views, 0.0)
    if num_comparable is not None:
        dissenting = np.clip(num_comparable - agreeing, 0.0, dissenting)
    # A view that does not agree differs by the tolerance at least.
    with_dissenting = (squares + _local_mean(dissenting) * tolerance**2) / np.maximum(
        others + _local_mean(dissenting), 1e-6
    )
    dissent = np.maximum(with_dissenting - disagreement, 0.0)
    second_differences = _local_mean(np.where(confirmed, _squared_second_differences(height), 0.0)) / np.maximum(
        _local_mean(confirmed), 1e-6
    )
    return np.sqrt(
        small_sample_factor(views) * (np.maximum(disagreement / views, second_differences) + dissent / views)
    )


def small_sample_factor(views: np.ndarray) -> np.ndarray:
    """Variance factor of heights on which few photographs agree, by Student's distribution.

    Local effects (a reflection, an occluding edge) are known from those photographs alone: Student's distribution with
    one degree of freedom more than there are photographs.
    """
    count = np.maximum(views.astype(np.float32), 2.0)
    return (count + 1.0) / (count - 1.0)


def _local_mean(values: np.ndarray) -> np.ndarray:
    return _gaussian(values.astype(np.float32), _LOCAL_PX, _LOCAL_STD_PX)


def _squared_second_differences(height: np.ndarray) -> np.ndarray:
    """Mean square of the second differences of heights across and down, [m^2]."""
    smooth = _gaussian(height.astype(np.float32), _AVERAGE_PX, _AVERAGED_PX)
    kernel = np.zeros((1, 2 * _WIDTH_PX + 1), dtype=np.float32)
    kernel[0, [0, _WIDTH_PX, -1]] = 1.0, -2.0, 1.0
    across, down = (cv2.filter2D(smooth, -1, each, borderType=cv2.BORDER_REFLECT) for each in (kernel, kernel.T))
    return 0.5 * (across * across + down * down)


def _gaussian(values: np.ndarray, side: int, std_px: float) -> np.ndarray:
    return cv2.GaussianBlur(values, (side, side), std_px, borderType=cv2.BORDER_REFLECT)
