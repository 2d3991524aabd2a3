"""Walls as a view sees them: by how much their height rises from pixel to pixel."""

from __future__ import annotations

import numpy as np

from refract import FlatWater, PinholeCamera

# Of the plumb line on which the image of a wall is found [m].
_STEP_M = 0.1
# Cosine of the widest angle in the image between the way in which heights rise and the plumb line. Beyond it a wall is
# seen from its end.
_LEAST_COSINE = 0.3


def wall_slopes(
    camera: PinholeCamera,
    water: FlatWater | None,
    ways: np.ndarray,
    extent: tuple[np.ndarray, np.ndarray],
    size: int,
    width_px: float,
) -> np.ndarray:
    """By how much the height of a vertical wall rises from row to row and from column to column of an image.

    The foot of the wall runs across the way in which the height map rises, and what stands over it lies along the image
    of the plumb line: both tell its plane.

    Parameters
    ----------
    camera, water
    ways : (rows, columns, 2)
        In which the heights of the tiles rise, of any length: `fields.sweep.images_host.ways`.
    extent : (rows, columns) each [m]
        Lowest and highest height of the tiles.
    size : [px]
        Of a tile.
    width_px : [px]
        Walls are seen so wide, or left out.

    Returns
    -------
    (rows, columns, 2) float [m/px]
        Of each tile of `fields.sweep.tiles`; NaN where no wall faces the view.
    """
    length = np.linalg.norm(ways, axis=-1)
    facing = np.argwhere(np.isfinite(extent[0]) & (length > 0.0))
    at, found = tuple(facing.T), np.full(ways.shape, np.nan)
    low, high = (each[at] for each in extent)
    way = ways[at] / length[at][:, None]
    plumb = _plumb_line(camera, water, size * (facing[:, ::-1] + 0.5), 0.5 * (low + high))[:, ::-1]
    # Pixels by which a wall rises in the image for each metre of height, across its foot.
    rise = (way * plumb).sum(axis=-1)
    seen = (rise * (high - low) > width_px) & (rise > _LEAST_COSINE * np.linalg.norm(plumb, axis=-1))
    found[tuple(facing[seen].T)] = way[seen] / rise[seen][:, None]
    return found


def _plumb_line(camera: PinholeCamera, water: FlatWater | None, pixels: np.ndarray, height: np.ndarray) -> np.ndarray:
    """How far (N, 2) [px/m] a point seen at pixels (N, 2) moves for each metre that it is higher."""
    half = 0.5 * _STEP_M * np.array(water.up if water is not None else (0.0, 0.0, 1.0))
    point = camera.paths(pixels, water).at_height(height, water)
    return (camera.project(point + half, water) - camera.project(point - half, water)) / _STEP_M
