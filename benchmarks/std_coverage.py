"""Coverage of standard deviations: the share of vertical errors within 1.96 of them, by classes of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from evaluation.vertical import vertical_difference

# 95 % of normally distributed errors lie within so many standard deviations.
WITHIN = 1.96
NUM_FIFTHS = 5
# Classes by the number of photographs that agree, the last one open.
VIEW_CLASSES = ((2, 2), (3, 4), (5, 7), (8, 65535))
# Steeper than this is a slope; what is steeper than `WALL_DEG` has no vertical error.
SLOPE_DEG, WALL_DEG = 20.0, 60.0
# Half of the baseline over which the slope of a reference is taken.
_BESIDE_M = 0.004


@dataclass(frozen=True)
class Coverage:
    """Share of the errors within 1.96 standard deviations (NaN of none), and the number of errors."""

    share: float
    num: int

    @staticmethod
    def of(error: np.ndarray, std: np.ndarray, mask: np.ndarray) -> Coverage:
        """Coverage of the errors (N,) [m] in a ``mask`` (N,) bool."""
        covered = np.abs(error[mask]) < WITHIN * std[mask]
        return Coverage(float(covered.mean()) if len(covered) else float("nan"), len(covered))


def coverage_by_class(
    error: np.ndarray, std: np.ndarray, num_views: np.ndarray, slope_deg: np.ndarray, is_wet: np.ndarray
) -> dict[str, Coverage]:
    """Coverage of all points, and by fifths of std, number of views, slope, and wet or dry.

    Parameters
    ----------
    error, std : (N,) [m]
        Vertical; finite.
    num_views : (N,) int
    slope_deg : (N,) [deg]
        Of the true surface.
    is_wet : (N,) bool

    Returns
    -------
    dict of str to Coverage
        By the name of the class.
    """
    fifth = np.digitize(std, np.quantile(std, np.arange(1, NUM_FIFTHS) / NUM_FIFTHS)) if len(std) else std
    classes = {"all": np.ones(len(std), dtype=bool)}
    classes |= {f"fifth {number + 1}": fifth == number for number in range(NUM_FIFTHS)}
    for low, high in VIEW_CLASSES:
        name = f"{low} views" if low == high else f"{low} to {high} views" if high < 65535 else f"{low} views and more"
        classes[name] = (num_views >= low) & (num_views <= high)
    classes |= {"slopes": slope_deg > SLOPE_DEG, "wet": is_wet, "dry": ~is_wet}
    return {name: Coverage.of(error, std, mask) for name, mask in classes.items()}


def slope_below(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Slope (N,) [deg] of a mesh straight above or below points (N, 3) [m]; NaN at its rim."""
    rise = []
    for axis in (0, 1):
        step = np.zeros(3)
        step[axis] = _BESIDE_M
        back, on = (vertical_difference(points + sign * step, vertices, faces) for sign in (-1.0, 1.0))
        rise.append((back - on) / (2.0 * _BESIDE_M))
    return np.degrees(np.arctan(np.hypot(*rise)))
