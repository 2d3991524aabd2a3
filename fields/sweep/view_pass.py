"""Matching of a view in a pass of the sweep: the whole image, the columns that may see an area, or a part in tiles.

Where heights around a pixel differ by more than a pass searches, all are tried.

The window of a coarse pass that holds the edge of a wall and the ground beside it finds one height, that of the side
with more texture, and the hypotheses of later passes do not reach the other side. Views from one side agree on that
error, so that nothing later takes it away. Here such pixels are matched at all heights around them, in small tiles: a
window needs its surroundings at its own height, or on its own wall, not at the heights of the pass before.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from fields.sweep import matching
from fields.sweep.block import Block
from fields.sweep.images import local_min_max, median, median_above, tile_extents, tile_gradients, upsample
from fields.sweep.kernels.arrays import Job
from fields.sweep.kernels.stack import Hypotheses
from fields.sweep.maps import HeightMap
from fields.sweep.matching import DiscontinuitySearch, Found, Pass, Reference
from fields.sweep.tiles import PART_SIDE_PX, Area, CornerRays, ImageTiles, extremes_of_squares, squares_over_area
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
    spacing, least = search.spacing_px / parallax, np.full(height.shape, matching.MATCHED_NCC, dtype=np.float32)
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

    yield from matching.match_tiles(reference, tiles, lambda part, _: tiles.starts(part).ravel(), spacing, take)
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
    line: both define its plane. ``gradients`` (rows, columns, 2): direction in which the heights of each tile rise, of
    any length: `fields.sweep.images.tile_gradients`. ``extent`` (rows, columns) each [m]: lowest and highest height of
    the tiles. ``size`` [px]: of a tile. ``width_px`` [px]: walls are seen so wide, or left out. Returns (rows, columns,
    2) float [m/px]: of each tile of `fields.sweep.tiles`; NaN where no wall faces the view.
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
    # How many pixels a wall rises in the image for each metre of height, across its foot.
    rise = (uphill * plumb).sum(axis=-1)
    seen = (rise * (high - low) > width_px) & (rise > _LEAST_COSINE * np.linalg.norm(plumb, axis=-1))
    found[tuple(facing[seen].T)] = uphill[seen] / rise[seen][:, None]
    return found


# Places along each side of the area: between them the outline of what is seen is straight to a fraction of a pixel.
_PLACES = 17
# Pixels added on every side, beside a window: of the straight outline, and for the surroundings of the last points.
_RIM_PX = 6


@dataclass(frozen=True)
class SweepSettings:
    """Settings of a sweep: range of heights, passes, area."""

    bound: tuple[float, float]  # (low, high) [m] over the water plane, spanned by the hypotheses of the first pass
    passes: tuple[Pass, ...] = matching.PASSES
    # (x0, y0, x1, y1) [m], local, where heights are wanted; other pixels get no height of their own
    area: Area | None = None


@dataclass(frozen=True)
class ViewPass:
    view: int  # index of the view
    neighbours: list[int]  # indices of the views that it is compared with
    count: int  # number of height hypotheses
    samples: int  # pixels x hypotheses x neighbours


@dataclass(frozen=True)
class MatchedView:
    """Map of a view after a pass, and how it was matched."""

    map: HeightMap
    extra_radius_px: int = 0  # radius of its windows less that of the pass
    refined_pixels: np.ndarray | None = None  # flat indices of the refined pixels; None of a whole view


def view_passes(block: Block, chosen: list[int], pass_: Pass, bound: tuple[float, float] | None) -> list[ViewPass]:
    """Work of a pass for each of the chosen views; those that overlap with no other are left out.

    The hypotheses span the bound (low, high) [m], or are as many as the pass has where that is None.
    """
    found = []
    for view in chosen:
        neighbours = block.neighbours(view, pass_.neighbours)
        if not neighbours:
            continue
        if bound is not None:
            step = _step(block, pass_, view, neighbours, 0.5 * (bound[0] + bound[1]))
            count = int(np.ceil((bound[1] - bound[0]) / step)) + 1
        elif pass_.hypotheses is not None:
            count = pass_.hypotheses
        else:
            raise ValueError("a pass after the first expects its own number of hypotheses, got None")
        found.append(ViewPass(view, neighbours, count, pixels_of(block, pass_, view) * count * len(neighbours)))
    return found


def pixels_of(block: Block, pass_: Pass, view: int) -> int:
    """Number of pixels of the image of a view at the scale of a pass."""
    camera = block.cameras[view].scaled(pass_.scale)
    return camera.width * camera.height


def _step(block: Block, pass_: Pass, view: int, neighbours: list[int], height: float) -> float:
    """Distance [m] between two hypotheses of a pass about a height [m]."""
    return pass_.spacing_px / (pass_.scale * block.parallax(view, neighbours, height))


def match_pass(
    block: Block,
    pass_: Pass,
    of_view: ViewPass,
    settings: SweepSettings,
    before: HeightMap | None,
    extra_radius_px: int,
) -> Job[MatchedView]:
    """Match a view in a pass, with the hypotheses of the bound or those about the heights of the pass before.

    The radius of the windows is that of the pass plus ``extra_radius_px``, or more where the scores ask for it.
    """
    stack, view = block.stack(pass_.scale), of_view.view
    bound, area = settings.bound, settings.area
    shape = (stack.cameras[view].height, stack.cameras[view].width)
    middle = 0.5 * (bound[0] + bound[1]) if before is None else median(before.height)
    step = _step(block, pass_, view, of_view.neighbours, middle)
    if before is None:
        start = np.full(shape, bound[0], dtype=np.float32)
    else:
        start = upsample(before.height, shape) - np.float32(step * (of_view.count // 2))

    over_area: list[np.ndarray] = []  # Asked for twice where heights are searched, too

    def columns(radius: int) -> np.ndarray | None:
        if area is None:
            return None
        if not pass_.in_area or before is None:
            return columns_seeing_area(stack.cameras[view], block.water, area, bound, radius)
        if not over_area:
            rays_of = partial(block.corner_rays, view)
            over_area.append(columns_over_area(block.cameras[view], shape, area, before.height, rays_of))
        return over_area[0]

    radius = pass_.radius + extra_radius_px
    reference = Reference(stack, view, of_view.neighbours, radius, _least_known(block))
    hypotheses = Hypotheses(start, step, of_view.count)
    if pass_.refines:
        found = yield from matching.match_view(reference, hypotheses, columns(radius))
    else:
        found, radius = yield from matching.match_with_adaptive_windows(reference, hypotheses, columns)
    # The search has windows of its own, narrower than those that were too narrow here.
    if pass_.discontinuities is not None and radius == pass_.radius:
        matched, spans = None, columns(radius) if pass_.in_area else None
        if spans is not None:
            matched = (np.arange(shape[1]) >= spans[:, :1]) & (np.arange(shape[1]) < spans[:, 1:])
        parallax = pass_.spacing_px / step
        found = yield from search_discontinuities(reference, found, parallax, pass_.discontinuities, matched)
    height, score, _ = found
    score = _of_shown(block, pass_, view, score).astype(np.float16)
    m = HeightMap(view, height, score, np.zeros(shape, dtype=np.uint8), np.zeros(shape, dtype=np.float16))
    return MatchedView(m, extra_radius_px=radius - pass_.radius)


def refine_part(block: Block, pass_: Pass, of_view: ViewPass, before: HeightMap, part: np.ndarray) -> Job[MatchedView]:
    """Match a part of a view in a pass, in tiles.

    ``part`` (height, width) bool is at a share of the size. All tiles that hold some of it are matched; other pixels
    stay as they were ``before``.
    """
    stack, view = block.stack(pass_.scale), of_view.view
    step = _step(block, pass_, view, of_view.neighbours, median(before.height))
    tiles = ImageTiles.over(part, before.height.shape, PART_SIDE_PX - 2 * pass_.radius, pass_.radius, of_view.count)
    shape, height, score = before.height.shape, before.height.flatten(), before.score.flatten()
    lowest = height - np.float32(step * (of_view.count // 2))

    def take(own: np.ndarray, pixels: np.ndarray, matched: list[np.ndarray]) -> None:
        best, best_score, _ = matched
        better = own & (best_score > matching.MATCHED_NCC)
        height[pixels[better]] = best[better]
        score[pixels[own]] = best_score[own]

    reference = Reference(stack, view, of_view.neighbours, pass_.radius, _least_known(block))
    yield from matching.match_tiles(reference, tiles, lambda _, pixels: lowest[pixels], step, take)
    score = _of_shown(block, pass_, view, score.reshape(shape))
    m = replace(before, height=height.reshape(shape), score=score)
    return MatchedView(m, refined_pixels=np.flatnonzero(tiles.wanted))


def _of_shown(block: Block, pass_: Pass, view: int, score: np.ndarray) -> np.ndarray:
    """Scores, -1 at masked pixels of the photograph, however much around them is known."""
    if pass_.scale < 1.0 or block.images.are_unmasked:
        return score
    return np.where(np.isnan(block.images[view]), score.dtype.type(-1.0), score)


def _least_known(block: Block) -> float:
    return 1.0 if block.images.are_unmasked else matching.LEAST_KNOWN


def outline_of(area: Area, water: FlatWater | None, bound: tuple[float, float]) -> np.ndarray:
    """Points (N, 3) [m], local, around an area at two heights [m] over the water plane."""
    x0, y0, x1, y1 = area
    along = np.linspace(0.0, 1.0, _PLACES)
    x = x0 + (x1 - x0) * np.concatenate([along, np.ones(_PLACES), 1.0 - along, np.zeros(_PLACES)])
    y = y0 + (y1 - y0) * np.concatenate([np.zeros(_PLACES), along, np.ones(_PLACES), 1.0 - along])
    plane, rise = (0.0, 1.0) if water is None else (water.height(x, y), 1.0 / water.up[2])
    return np.concatenate([np.stack([x, y, plane + np.full_like(x, rise * height)], axis=-1) for height in bound])


def columns_seeing_area(
    camera: PinholeCamera, water: FlatWater | None, area: Area, bound: tuple[float, float], radius: int
) -> np.ndarray:
    """First column, and the one after the last, in which each row may see the area, (height, 2) int; none: equal ones.

    ``area`` (x0, y0, x1, y1) [m], local. ``bound`` (low, high) [m] over the water plane: in which the bed lies.
    ``radius`` [px]: of the window about a pixel.
    """
    seen = camera.project(outline_of(area, water, bound), water)
    if not np.isfinite(seen).all():  # a part of the area is behind the camera
        return np.tile([0, camera.width], (camera.height, 1))
    size = np.array([camera.width, camera.height])
    hull = cv2.convexHull(np.clip(seen, -4.0 * size, 5.0 * size).astype(np.int32))
    mask = cv2.fillConvexPoly(np.zeros((camera.height, camera.width), np.uint8), hull, 1)
    mask = cv2.dilate(mask, np.ones((2 * (radius + _RIM_PX) + 1,) * 2, np.uint8)).astype(bool)
    return _columns_of(mask)


def columns_over_area(
    camera: PinholeCamera,
    shape: tuple[int, int],
    area: Area,
    height: np.ndarray,
    rays_of: Callable[[tuple[int, int]], CornerRays],
) -> np.ndarray:
    """Columns with pixels that see the area at heights (height, width) [m] of a map, or around them.

    ``camera``: of full size. ``shape`` (height, width) [px]: of the image whose columns are wanted; the map may be
    smaller. ``rays_of``: `CornerRays` of the camera for so many rows and columns of squares.
    """
    low, high, side = extremes_of_squares(camera, height)
    meets = squares_over_area(rays_of(low.shape), area, low, high)
    of_row, of_column = (
        ((np.arange(full_length) + 0.5) * length / full_length).astype(int) // side
        for full_length, length in zip(shape, height.shape, strict=True)
    )
    return _columns_of(meets[np.ix_(of_row, of_column)])


def _columns_of(mask: np.ndarray) -> np.ndarray:
    """First column, and the one after the last, of each row of a mask; equal ones of none."""
    first, last = mask.argmax(axis=1), mask.shape[1] - mask[:, ::-1].argmax(axis=1)
    return np.where(mask.any(axis=1, keepdims=True), np.stack([first, last], axis=1), [0, 0])
