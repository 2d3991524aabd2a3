"""Search at height discontinuities: where heights around a pixel differ by more than a pass searches, all are tried.

The window of a coarse pass that holds the edge of a wall and the ground beside it finds one height, that of the side
with more texture, and the hypotheses of later passes do not reach the other side. Views from one side agree on that
error, so that nothing later takes it away. Here such pixels are matched at all heights around them, in small tiles: a
window needs its surroundings at its own height, or on its own wall, not at the heights of the pass before.
"""

from __future__ import annotations

import numpy as np

from fields.sweep.images import local_min_max, median, median_above, tile_extents, tile_gradients
from fields.sweep.kernels.arrays import Job
from fields.sweep.matching import Found, Reference, match_tiles
from fields.sweep.passes import MATCHED_NCC, DiscontinuitySearch
from fields.sweep.tiles import ImageTiles
from refract import FlatWater, PinholeCamera

_STEP_M = 0.1  # Of the plumb line on which the image of a wall is found [m]
# Cosine of the widest angle in the image between the way in which heights rise and the plumb line. Beyond it a wall is
# seen from its end.
_LEAST_COSINE = 0.3


def search_discontinuities(
    reference: Reference, found: Found, parallax: float, search: DiscontinuitySearch, matched: np.ndarray | None = None
) -> Job[Found]:
    """Height, score and curvature of a pass, with those of the search where heights around differ.

    ``reference``: of the pass; the windows are those of the search. ``found``: height [m], score, curvature [1/m^2],
    (height, width) float32 each. ``parallax`` [px/m]: at the scale of the stack, per metre of height. ``matched``
    (height, width) bool, optional: pixels that are searched: those that were matched, of a view of which parts were
    not.
    """
    stack, height, score = reference.stack, found[0], found[1]
    typical = median(score) if matched is None else median_above(score, -1.0)
    if typical is None or typical < search.least_score or min(height.shape) < search.tile_px + 2 * search.radius:
        return found
    low, high = local_min_max(height, search.around_px)
    searched = (high - low) * parallax > search.reach_px
    if matched is not None:
        # Heights continue beyond what was matched, and lines between them look like discontinuities.
        searched &= matched
    if not searched.any():
        return found
    nearby = Reference(stack, reference.view, reference.neighbours[: search.neighbours], search.radius)
    spacing, least = search.spacing_px / parallax, np.full(height.shape, MATCHED_NCC, dtype=np.float32)
    size, bounds = search.tile_px, tile_extents(searched, low, high, search.tile_px)
    level = ImageTiles.of(searched, bounds, spacing, size, search.radius)
    found = yield from _best_of_tiles(nearby, found, level, spacing, least)
    if search.walls:
        width, gradients = 2.0 * search.radius + 1.0, tile_gradients(height, searched, size)
        slope = wall_slopes(stack.cameras[nearby.view], stack.water, gradients, bounds, size, width)
        upright = ImageTiles.of(searched, bounds, spacing, size, search.radius, slope)
        found = yield from _best_of_tiles(nearby, found, upright, spacing, np.maximum(least, found[1]))
    return found


def _best_of_tiles(
    reference: Reference, found: Found, tiles: ImageTiles, spacing: float, least: np.ndarray
) -> Job[Found]:
    """Heights replaced by those of tiles, with hypotheses ``spacing`` [m] apart, where these score over ``least``."""
    better, worse = [each.flatten() for each in found], least.ravel()

    def take(own: np.ndarray, pixels: np.ndarray, matched: list[np.ndarray]) -> None:
        keep = own & (matched[1] > worse[pixels])
        for target, each in zip(better, matched, strict=True):
            target[pixels[keep]] = each[keep]

    yield from match_tiles(reference, tiles, lambda part, _: tiles.starts(part).ravel(), spacing, take)
    height, score, curvature = (each.reshape(found[0].shape) for each in better)
    return height, score, curvature


def wall_slopes(
    camera: PinholeCamera,
    water: FlatWater | None,
    gradients: np.ndarray,
    extent: tuple[np.ndarray, np.ndarray],
    size: int,
    width_px: float,
) -> np.ndarray:
    """Gradient of the height of a vertical wall along the rows and columns of an image.

    The foot of the wall is normal to the gradient of the height map, and its face lies along the image of the plumb
    line: both define its plane.

    ``gradients`` (rows, columns, 2): direction in which the heights of each tile rise, of any length:
    `fields.sweep.images.tile_gradients`. ``extent`` (rows, columns) each [m]: lowest and highest height of the tiles.
    ``size`` [px]: of a tile. ``width_px`` [px]: walls are seen so wide, or left out. Returns (rows, columns, 2) float
    [m/px]: of each tile of `fields.sweep.tiles`; NaN where no wall faces the view.
    """
    length = np.linalg.norm(gradients, axis=-1)
    facing = np.argwhere(np.isfinite(extent[0]) & (length > 0.0))
    at, found = tuple(facing.T), np.full(gradients.shape, np.nan)
    low, high = (each[at] for each in extent)
    uphill = gradients[at] / length[at][:, None]
    # Image motion of the points seen in the middle of the tiles per metre of height.
    half = 0.5 * _STEP_M * np.array(water.up if water is not None else (0.0, 0.0, 1.0))
    point = camera.paths(size * (facing[:, ::-1] + 0.5), water).at_height(0.5 * (low + high), water)
    plumb = ((camera.project(point + half, water) - camera.project(point - half, water)) / _STEP_M)[:, ::-1]
    # Pixels by which a wall rises in the image for each metre of height, across its foot.
    rise = (uphill * plumb).sum(axis=-1)
    seen = (rise * (high - low) > width_px) & (rise > _LEAST_COSINE * np.linalg.norm(plumb, axis=-1))
    found[tuple(facing[seen].T)] = uphill[seen] / rise[seen][:, None]
    return found
