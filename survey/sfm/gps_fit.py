"""Fit of a block to GPS positions: residuals, and whether they determine its orientation."""

from __future__ import annotations

import math

import numpy as np

from geo.similarity import gross_error
from survey.errors import PosesError

# Accuracy of a receiver with carrier-phase corrections: the smallest standard deviation that is assumed.
MIN_STD_M = 0.02
# Cameras closer to one line than this many std, or share of its length, leave the tilt of the block about it open.
_LINE_STD, _LINE_SHARE = 3.0, 0.03
# When the shape of all positions is asked for, one of so many may be wrong: farther from their middle than the median
# by this factor. Of a strip the ends are twice as far.
_ONE_WRONG_OF, _FAR = 5, 8.0
# Fewer residuals do not tell a wrong one.
_FEWEST = 4


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
    num = len(positions)
    # A wrong position may make a line of an area, and an area of a line.
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    far = away > _FAR * np.median(away)
    spread = _spread(positions[~far] if far.sum() <= num // _ONE_WRONG_OF else positions)
    if spread[1] < max(_LINE_STD * std_m, _LINE_SHARE * spread[0]):
        raise PosesError(
            f"the GPS positions of the {num} images lie on one line (spread {spread[0]:.1f} m along and "
            f"{spread[1]:.1f} m across, positions good to {std_m:.2g} m), which leaves the tilt of the block about it "
            "open; add images of a second strip, or give poses made elsewhere in [cameras] poses"
        )


def contradicted(residuals) -> np.ndarray:
    """Which positions (N,) bool the block contradicts, by their residuals (N, 3) [m], local; NaN counts for nothing.

    Residuals may have a shift in common, as heights by a barometer do.
    """
    residuals = np.asarray(residuals, dtype=np.float64)
    known = np.isfinite(residuals).all(axis=1)
    wrong = np.zeros(len(residuals), dtype=bool)
    if known.sum() < _FEWEST:
        return wrong
    away = np.linalg.norm(residuals[known] - np.median(residuals[known], axis=0), axis=1)
    # At first no more than half of them are trusted, as in `geo.similarity.robust_similarity`.
    num = len(away) // 2 + 1
    for _ in range(2):
        is_wrong = away > gross_error(float(np.median(away)), num)
        num = max(int((~is_wrong).sum()), num)
    wrong[known] = is_wrong
    return wrong


def _spread(positions: np.ndarray) -> np.ndarray:
    """Root mean squares (3,) [m] of positions along their principal axes, the largest first."""
    return np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False) / math.sqrt(len(positions))
