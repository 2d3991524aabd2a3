"""A photograph with its camera in the local frame, and spatial intersection: a point from its marks in several.

Residuals are those of the collinearity equations; under water rays are bent, see `PinholeCamera.project`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from refract import FlatWater, PinholeCamera
from refract.lens import Lens

# Rays that intersect at a smaller angle [rad] than this do not determine a distance.
_LEAST_ANGLE = 0.02
_ROUNDS = 10


@dataclass(frozen=True)
class View:
    """Photograph with its camera."""

    name: str  # Path of the image below the image folder, with forward slashes
    path: Path
    camera: PinholeCamera  # Of the photograph as it was taken, lens distortion included; local frame, at full size
    lens: Lens  # Interior orientation, as the poses file or survey.toml gives it
    mask_path: Path | None = None  # Image of the stored size; black is left out


def metres_per_px(views: Sequence[View], water: FlatWater | None) -> float | None:
    """Ground sampling distance [m/px] on the water under the cameras, median; None for a dry survey."""
    if water is None:
        return None
    return float(np.median([-float(water.depth(view.camera.centre)) / view.lens.focal[1] for view in views]))


@dataclass(frozen=True, eq=False)
class Intersection:
    """The place of a point by its marks."""

    place: np.ndarray  # (3,) [m], local
    covariance: np.ndarray  # (3, 3) [m^2]: Propagated from the standard deviations of the marks
    residuals: np.ndarray  # (N, 2) [px]: marks minus projections of the place


def intersect(
    cameras: Sequence[PinholeCamera], pixels: np.ndarray, stds_px: np.ndarray, water: FlatWater | None
) -> Intersection | None:
    """Intersection of the rays of N marks; None where they do not meet, or are nearly parallel.

    Marks are pixels (N, 2) with their stds (N,) [px]; without water all rays are straight.
    """
    if len(cameras) < 2:
        return None
    rays = np.array([camera.directions(pixel) for camera, pixel in zip(cameras, pixels, strict=True)])
    centres = np.array([camera.centre for camera in cameras])
    cosines = np.clip(rays @ rays.T, -1.0, 1.0)
    if not np.isfinite(rays).all() or np.arccos(cosines.min()) < _LEAST_ANGLE:
        return None
    normal, right = equations_of_lines(centres, rays)
    place = np.linalg.solve(normal.sum(axis=0), right.sum(axis=0))
    std = np.repeat(np.asarray(stds_px, dtype=np.float64), 2)
    for _ in range(_ROUNDS):
        residual, jacobian = _residuals(cameras, pixels, place, water)
        if not np.isfinite(residual).all() or not np.isfinite(jacobian).all():
            return None
        step = np.linalg.lstsq(jacobian / std[:, None], -residual / std, rcond=None)[0]
        place = place + step
        if np.abs(step).max() < 1e-6:
            break
    residual, jacobian = _residuals(cameras, pixels, place, water)
    if not np.isfinite(residual).all() or not np.isfinite(jacobian).all():
        return None
    covariance = np.linalg.inv((jacobian / std[:, None]).T @ (jacobian / std[:, None]))
    return Intersection(place, covariance, -residual.reshape(-1, 2))


def equations_of_lines(through: np.ndarray, along: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations (N, 3, 3) and (N, 3) of places on lines; summed over lines, of the place nearest to all.

    Lines go through places (N, 3) along unit directions (N, 3).
    """
    across = np.eye(3) - along[:, :, None] * along[:, None, :]
    return across, np.einsum("nij,nj->ni", across, through)


def projection_and_jacobian(
    camera: PinholeCamera, place: np.ndarray, water: FlatWater | None
) -> tuple[np.ndarray, np.ndarray]:
    """The pixel (2,) at which a place (3,) appears, and its derivative (2, 3) [px/m]; NaN behind the camera."""
    step = 1e-6 * np.linalg.norm(camera.centre - place)
    moved = camera.project(place + step * np.vstack([np.zeros(3), np.eye(3), -np.eye(3)]), water)
    return moved[0], (moved[1:4] - moved[4:]).T / (2.0 * step)


def _residuals(
    cameras: Sequence[PinholeCamera], pixels: np.ndarray, place: np.ndarray, water: FlatWater | None
) -> tuple[np.ndarray, np.ndarray]:
    """Residuals of a place at its marks (2 N,) [px], and their derivatives (2 N, 3)."""
    seen = [projection_and_jacobian(camera, place, water) for camera in cameras]
    residual = np.concatenate([at - pixel for (at, _), pixel in zip(seen, pixels, strict=True)])
    return residual, np.concatenate([jacobian for _, jacobian in seen])
