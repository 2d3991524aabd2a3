"""How well GPS positions fit a block of photographs, and whether they can place it."""

from __future__ import annotations

import math

import numpy as np

from survey.errors import PosesError

# Accuracy of a receiver with carrier-phase corrections: the smallest standard deviation that is assumed.
MIN_STD_M = 0.02
# Cameras closer to one line than this many std, or share of its length, leave the tilt of the block about it open.
_LINE_STD, _LINE_SHARE = 3.0, 0.03


def gps_std(residuals) -> np.ndarray:
    """Standard deviation (3,) [m] of GPS positions: east and north alike, up; from residuals (N, 3) [m], local.

    The seven parameters of the similarity reduce the degrees of freedom; never below `MIN_STD_M`.
    """
    residuals = np.asarray(residuals, dtype=np.float64)
    share = max(3.0 * len(residuals) - 7.0, 1.0) / (3.0 * len(residuals))
    mean_squares = (residuals**2).mean(axis=0) / share
    level = math.sqrt(0.5 * (mean_squares[0] + mean_squares[1]))
    return np.maximum([level, level, math.sqrt(mean_squares[2])], MIN_STD_M)


def require_area(positions, std_m: float) -> None:
    """Raise where positions (N, 3) [m], local, lie on one line and leave the tilt about it open.

    Raises
    ------
    PosesError
        With the extent along and across, and advice.
    """
    positions = np.asarray(positions, dtype=np.float64)
    spread = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / math.sqrt(len(positions))
    if spread[1] < max(_LINE_STD * std_m, _LINE_SHARE * spread[0]):
        raise PosesError(
            f"the GPS positions of the {len(positions)} images lie on one line (spread {spread[0]:.1f} m along and "
            f"{spread[1]:.1f} m across, positions good to {std_m:.2g} m), which leaves the tilt of the block about it "
            "open; add images of a second strip, or give poses made elsewhere in [cameras] poses"
        )
