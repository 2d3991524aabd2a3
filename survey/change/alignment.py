"""Co-registration in height of two surveys on ground that did not change.

The second survey is shifted by the mean difference there. What both surveys have in common in all their cells then
counts no more: in place of it stands the standard deviation of that mean, by the errors of its cells. What of
``std_common`` grows over a survey, by a tilt or with the depth, stays: its square beyond the least of the survey, at a
cell and on the stable ground, as independent errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from survey.change.volume import CHANGED, MAD_TO_STD, Correlation, Differences, volume_of

# Fewer cells than this say too little of a mean, and of which of them changed all the same.
FEWEST_CELLS = 30


@dataclass(frozen=True)
class Alignment:
    """Shift of the second survey."""

    shift_m: float  # [m]: added to its heights
    std_m: float  # [m]: standard deviation of the shift
    area_m2: float  # [m²]: of the stable ground that counted
    left_out: int  # Cells of it whose difference lies beyond three robust standard deviations


def aligned(differences: Differences, stable: np.ndarray, correlation: Correlation) -> tuple[Differences, Alignment]:
    """The differences after the second survey was put onto the first, and by how much.

    Parameters
    ----------
    differences : Differences
    stable : (rows, columns) bool
        Cells that did not change.
    correlation : Correlation
        Of the errors of cells.

    Raises
    ------
    ValueError
        If fewer than `FEWEST_CELLS` of them are known.
    """
    known = stable & differences.is_known
    if known.sum() < FEWEST_CELLS:
        raise ValueError(f"{int(known.sum())} cells of both surveys lie in it, expected at least {FEWEST_CELLS}")
    away = np.abs(differences.height - np.median(differences.height[known]))
    used = known & (away <= CHANGED * MAD_TO_STD * max(float(np.median(away[known])), 1e-12))
    # Where unchanged cells scatter more than they state, their mean does too.
    scatter = max(1.0, correlation.scatter or 1.0)
    own = replace(differences, std=scatter * differences.std, common=np.zeros_like(differences.common))
    total = volume_of(own, used, correlation)
    mean, std = total.volume_m3 / total.area_m2, total.std_m3 / total.area_m2
    found = Alignment(-mean, std, total.area_m2, int(known.sum() - used.sum()))
    return replace(
        differences,
        height=differences.height - mean,
        common=np.stack([np.hypot(_growing(differences, used), std), np.zeros(used.shape)]),
        shared=0.0,
    ), found


def _growing(differences: Differences, used: np.ndarray) -> np.ndarray:
    """Standard deviation (rows, columns) [m] of common errors that are not the same in all cells."""
    variances = [each**2 - np.nanmin(each[differences.is_known]) ** 2 for each in differences.common]
    first, second = (np.sqrt(np.maximum(each, 0.0) + max(float(each[used].mean()), 0.0)) for each in variances)
    return np.sqrt(np.maximum(first**2 + second**2 - 2.0 * differences.shared * first * second, 0.0))
