"""Matching of a view in a pass of the sweep: the whole image, the columns that may see an area, or a part in tiles."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from fields.sweep.block import Block
from fields.sweep.discontinuities import search_discontinuities
from fields.sweep.images import median, upsample
from fields.sweep.kernels.arrays import Job
from fields.sweep.kernels.stack import Hypotheses
from fields.sweep.maps import HeightMap
from fields.sweep.matching import LEAST_KNOWN, Reference, match_tiles, match_view, match_with_adaptive_windows
from fields.sweep.passes import MATCHED_NCC, PASSES, Pass
from fields.sweep.tiles import PART_SIDE_PX, Area, CornerRays, ImageTiles, extremes_of_squares, squares_over_area
from refract import FlatWater, PinholeCamera

# Places along each side of the area: between them the outline of what is seen is straight to a fraction of a pixel.
_PLACES = 17
# Pixels added on every side, beside a window: of the straight outline, and for the surroundings of the last points.
_RIM_PX = 6


@dataclass(frozen=True)
class SweepSettings:
    """Settings of a sweep: range of heights, passes, area."""

    bound: tuple[float, float]  # (low, high) [m] over the water plane, spanned by the hypotheses of the first pass
    passes: tuple[Pass, ...] = PASSES
    # (x0, y0, x1, y1) [m], local, where heights are wanted; other pixels get no height of their own
    area: Area | None = None


@dataclass(frozen=True)
class ViewPass:
    """Work of one pass for one view."""

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
        found = yield from match_view(reference, hypotheses, columns(radius))
    else:
        found, radius = yield from match_with_adaptive_windows(reference, hypotheses, columns)
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
        better = own & (best_score > MATCHED_NCC)
        height[pixels[better]] = best[better]
        score[pixels[own]] = best_score[own]

    reference = Reference(stack, view, of_view.neighbours, pass_.radius, _least_known(block))
    yield from match_tiles(reference, tiles, lambda _, pixels: lowest[pixels], step, take)
    score = _of_shown(block, pass_, view, score.reshape(shape))
    m = replace(before, height=height.reshape(shape), score=score)
    return MatchedView(m, refined_pixels=np.flatnonzero(tiles.wanted))


def _of_shown(block: Block, pass_: Pass, view: int, score: np.ndarray) -> np.ndarray:
    """Scores, -1 at masked pixels of the photograph, however much around them is known."""
    if pass_.scale < 1.0 or block.images.are_unmasked:
        return score
    return np.where(np.isnan(block.images[view]), score.dtype.type(-1.0), score)


def _least_known(block: Block) -> float:
    return 1.0 if block.images.are_unmasked else LEAST_KNOWN


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
