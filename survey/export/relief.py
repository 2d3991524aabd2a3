"""Slope and shading of a raster of heights."""

from __future__ import annotations

import math

import numpy as np

_SUN_HEIGHT, _SUN_AZIMUTH = math.radians(45.0), math.radians(315.0)


def gradient(height: np.ndarray, side: float) -> tuple[np.ndarray, np.ndarray]:
    """Rise to the east and to the north [-] of heights (rows, columns), NaN where there is none.

    Central differences (L. Zevenbergen and C. Thorne 1987), or one-sided ones where a neighbour is missing.
    """
    return _differences(height, side), -_differences(height.T, side).T


def _differences(height: np.ndarray, side: float) -> np.ndarray:
    """Rise along the columns [-]."""
    padded = np.pad(height, ((0, 0), (1, 1)), constant_values=np.nan)
    before, after = padded[:, :-2], padded[:, 2:]
    both = (after - before) / (2.0 * side)
    one = np.where(np.isfinite(after), after - height, height - before) / side
    return np.where(np.isfinite(height) & np.isfinite(both), both, one)


def slope_deg(height: np.ndarray, side: float) -> np.ndarray:
    """Steepest slope [deg] of heights (rows, columns) [m]; NaN where a direction has no neighbour."""
    east, north = gradient(height, side)
    return np.degrees(np.arctan(np.hypot(east, north)))


def hillshade(height: np.ndarray, side: float) -> np.ndarray:
    """Hillshade (rows, columns) uint8 with light from the north-west at 45 degrees, 1 to 255; 0 where unknown."""
    east, north = gradient(height, side)
    toward = east * math.sin(_SUN_AZIMUTH) + north * math.cos(_SUN_AZIMUTH)
    light = (math.sin(_SUN_HEIGHT) - math.cos(_SUN_HEIGHT) * toward) / np.sqrt(1.0 + east**2 + north**2)
    known = np.isfinite(light)
    return np.where(known, 1.0 + 254.0 * np.clip(np.where(known, light, 0.0), 0.0, 1.0), 0.0).round().astype(np.uint8)
