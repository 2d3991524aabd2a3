"""Fit of a block to GPS positions: residuals, and whether they determine its orientation."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from geo.similarity import gross_error

# Accuracy of a receiver with carrier-phase corrections: the smallest standard deviation that is assumed.
MIN_STD_M = 0.02
# Cameras closer to one line than this many std, or share of its length, leave the roll of the block about it open.
_LINE_STD, _LINE_SHARE = 3.0, 0.03
HOLD_THE_ROLL = (
    "give a control point some metres beside the line, attitudes of the camera in XMP, or a level of water that the "
    "photographs show, or add images of a second strip"
)
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


@dataclass(frozen=True)
class Line:
    """A line that positions lie on, given how good they are: they leave the roll of a block about it open.

    Attributes
    ----------
    centre, direction : (3,) [m], local; (3,)
    along, across : float [m]
        Root mean squares of the positions along the line and beside it.
    std_m : float [m]
        Of the positions.
    what : str
        What they are, as a plural.
    """

    centre: np.ndarray
    direction: np.ndarray
    along: float
    across: float
    std_m: float
    what: str = "GPS positions"

    def said(self, num: int) -> str:
        """The finding on so many of them, as a clause."""
        return (
            f"{num} {self.what} lie on one line (spread {self.along:.1f} m along and {self.across:.2f} m across, good "
            f"to {self.std_m:.2g} m), which leaves the roll of the block about it open"
        )


def line_of(positions, std_m: float) -> Line | None:
    """The line that positions (N, 3) [m], local, lie on; None where they span an area."""
    positions = np.asarray(positions, dtype=np.float64)
    num = len(positions)
    # A wrong position may make a line of an area, and an area of a line.
    away = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    far = away > _FAR * np.median(away)
    kept = positions[~far] if far.sum() <= num // _ONE_WRONG_OF else positions
    centre = kept.mean(axis=0)
    _, lengths, axes = np.linalg.svd(kept - centre, full_matrices=False)
    along, across = (float(length) for length in lengths[:2] / math.sqrt(len(kept)))
    return Line(centre, axes[0], along, across, std_m) if across < max(_LINE_STD * std_m, _LINE_SHARE * along) else None


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
