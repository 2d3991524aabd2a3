"""Predicted pixels of tie points through the water surface, and their derivatives by points and by parameters."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from refract import FlatWater, PinholeCamera, crossing_point
from refract.distortion import distort, kinds_of, row_of
from survey.photos.tie_points import TiePoints

# Half a step of the central differences: the projection is exact to 1e-12 px or so and curves on the scale of metres,
# so that their error stays under 1e-7 of a derivative.
_STEP = 1e-4
# Four are exact to the last bits in drone geometry (docs/optics.md), two more for lower flights.
_NEWTON_STEPS = 6


def pixels_of(
    cameras: Sequence[PinholeCamera], ties: TiePoints, points: np.ndarray, water: FlatWater | None
) -> np.ndarray:
    """Predicted pixels (N, 2) of all observations: `PinholeCamera.project` for many cameras at once."""
    centres = np.array([camera.centre for camera in cameras])[ties.view]
    rotations = np.array([camera.cam_from_local for camera in cameras])[ties.view]
    inner = np.array([(camera.fx, camera.fy, camera.cx, camera.cy) for camera in cameras])[ties.view]
    seen = crossing_point(points[ties.point], centres, water, steps=_NEWTON_STEPS) - centres
    x, y, z = np.einsum("nij,nj->in", rotations, seen)
    z = np.where(z > 0.0, z, np.nan)
    x, y = x / z, y / z
    lenses = kinds_of(camera.distortion for camera in cameras)
    if lenses:
        x, y = distort(lenses, x, y, np.array([row_of(camera.distortion) for camera in cameras])[ties.view].T)
    return np.stack([inner[:, 0] * x + inner[:, 2], inner[:, 1] * y + inner[:, 3]], axis=-1)


def residuals_of(
    cameras: Sequence[PinholeCamera], ties: TiePoints, points: np.ndarray, water: FlatWater | None
) -> np.ndarray:
    """Measured minus predicted pixels (N, 2) [px] for points (M, 3) [m], local."""
    return ties.pixel - pixels_of(cameras, ties, points, water)


def by_point(cameras, ties: TiePoints, points: np.ndarray, water) -> np.ndarray:
    """Derivative of the pixels by the points, (N, 2, 3)."""
    moves = _STEP * np.eye(3)
    return np.stack([_difference(cameras, ties, (points + m, water), (points - m, water)) for m in moves], axis=-1)


def by_parameters(cameras, ties: TiePoints, points: np.ndarray, water_of, parameters: np.ndarray) -> np.ndarray:
    """Derivative of the pixels by the parameters of the water, (N, 2, P)."""
    moves = _STEP * np.eye(len(parameters))
    ends = [(water_of(parameters + m), water_of(parameters - m)) for m in moves]
    return np.stack([_difference(cameras, ties, (points, a), (points, b)) for a, b in ends], axis=-1)


def _difference(cameras, ties: TiePoints, ahead, behind) -> np.ndarray:
    return (pixels_of(cameras, ties, *ahead) - pixels_of(cameras, ties, *behind)) / (2.0 * _STEP)
