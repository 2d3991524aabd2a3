"""Which pixels of a view can see the area that is asked for: the others need no height."""

from __future__ import annotations

import cv2
import numpy as np

from refract import FlatWater, PinholeCamera

Area = tuple[float, float, float, float]

# Places along each side of the area: between them the outline of what is seen is straight to a fraction of a pixel.
_PLACES = 17
# Pixels added on every side, beside a window: of the straight outline, and for the surroundings of the last points.
_RIM_PX = 6


def columns_over(
    camera: PinholeCamera, water: FlatWater | None, area: Area, bound: tuple[float, float], radius: int
) -> np.ndarray:
    """First column, and the one after the last, in which each row may see the area, (height, 2) int; none: equal ones.

    Parameters
    ----------
    camera : PinholeCamera
    water : FlatWater or None
    area : (x0, y0, x1, y1) [m], local
    bound : (low, high) [m] over the water plane
        In which the bed lies.
    radius : [px]
        Of the window about a pixel.
    """
    x0, y0, x1, y1 = area
    along = np.linspace(0.0, 1.0, _PLACES)
    x = x0 + (x1 - x0) * np.concatenate([along, np.ones(_PLACES), 1.0 - along, np.zeros(_PLACES)])
    y = y0 + (y1 - y0) * np.concatenate([np.zeros(_PLACES), along, np.ones(_PLACES), 1.0 - along])
    plane, rise = (0.0, 1.0) if water is None else (water.height(x, y), 1.0 / water.up[2])
    outline = np.concatenate([np.stack([x, y, plane + np.full_like(x, rise * height)], axis=-1) for height in bound])
    seen = camera.project(outline, water)
    columns = np.tile([0, camera.width], (camera.height, 1))
    if not np.isfinite(seen).all():  # a part of the area is behind the camera
        return columns
    size = np.array([camera.width, camera.height])
    hull = cv2.convexHull(np.clip(seen, -4.0 * size, 5.0 * size).astype(np.int32))
    mask = cv2.fillConvexPoly(np.zeros((camera.height, camera.width), np.uint8), hull, 1)
    mask = cv2.dilate(mask, np.ones((2 * (radius + _RIM_PX) + 1,) * 2, np.uint8)).astype(bool)
    columns[:, 0] = np.where(mask.any(axis=1), mask.argmax(axis=1), 0)
    columns[:, 1] = np.where(mask.any(axis=1), camera.width - mask[:, ::-1].argmax(axis=1), 0)
    return columns
