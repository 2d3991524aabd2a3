"""The surface that a camera sees of height maps, from a z-buffer."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.ndimage import distance_transform_edt

from refract import FlatWater, PinholeCamera

# Of the pixels of a map along each side one in so many is splatted: several maps overlap.
_STRIDE = 2
# Gaps of the surface up to this wide take the height of the nearest pixel [px].
_GAP_PX = 8


@dataclass(frozen=True)
class Splats:
    """Points of every `_STRIDE`-th pixel of a height map along each side that has a height."""

    camera: PinholeCamera  # whose pixels those of the map are
    points: np.ndarray  # (N, 3) [m]: local
    heights: np.ndarray  # (N,) [m]: over the water plane

    @classmethod
    def of(cls, camera: PinholeCamera, heights: np.ndarray, optics: FlatWater | None) -> Splats:
        """Splats of heights (rows, columns) [m] of the paths of a camera's pixels; NaN where there is none."""
        rows, columns = _STRIDE * np.stack(np.nonzero(np.isfinite(heights[::_STRIDE, ::_STRIDE])))
        height = heights[rows, columns].astype(np.float64)
        path = camera.paths(np.column_stack([columns + 0.5, rows + 0.5]), optics)
        return cls(camera, path.at_height(height, optics), height)

    def spacing_px(self, camera: PinholeCamera) -> float:
        """Distance [px] at which neighbouring points appear in another camera, by distances and focal lengths."""
        some = self.points[:: max(len(self.points) // 1000, 1)]
        own, other = (np.linalg.norm(some - c.centre, axis=1) for c in (camera, self.camera))
        return float(np.median(other / own)) * _STRIDE * camera.fx / self.camera.fx


def front_surface(
    camera: PinholeCamera, optics: FlatWater | None, maps: Iterable[Splats], tolerance: float
) -> np.ndarray:
    """Heights (height, width) float32 [m] of the nearest surface of maps, from a z-buffer; NaN without one.

    Along a ray that comes down heights fall, so the highest point of a pixel is the nearest. Where the maps are
    coarser than the target, the buffer is as coarse, so that what lies behind does not show through. Heights that lie
    by less than a tolerance [m] below the highest are of the same surface, and averaged.
    """
    spacing, seen = [], []
    for splats in maps:
        if len(splats.points):
            spacing.append(splats.spacing_px(camera))
            seen.append((camera.project(splats.points, optics), splats.heights))
    if not seen:
        return np.full((camera.height, camera.width), np.nan, dtype=np.float32)
    scale = min(1.0, 1.0 / float(np.median(spacing)))
    width, height = (max(round(size * scale), 1) for size in (camera.width, camera.height))
    top = np.full(width * height, -np.inf)
    for number, (uv, z) in enumerate(seen):
        inside = camera.sees(uv)
        uv = uv[inside] * (width / camera.width, height / camera.height)
        cell, z = uv.astype(np.int64) @ [1, width], z[inside]
        np.maximum.at(top, cell, z)
        seen[number] = cell, z
    total, count = np.zeros(width * height), np.zeros(width * height)
    for cell, z in seen:
        front = z > top[cell] - tolerance
        total += np.bincount(cell[front], z[front], minlength=len(top))
        count += np.bincount(cell[front], minlength=len(top))
    with np.errstate(invalid="ignore"):
        mean = (total / count).reshape(height, width).astype(np.float32)
    if np.isnan(mean).all():
        return np.full((camera.height, camera.width), np.nan, dtype=np.float32)
    far, nearest = distance_transform_edt(np.isnan(mean), return_indices=True)
    mean = np.where(far <= _GAP_PX * scale, mean[tuple(nearest)], np.nan)
    return cv2.resize(mean, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST)
