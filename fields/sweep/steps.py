"""Steps of the bed: where the heights around a pixel differ by more than a ladder reaches, all between them are tried.

The window of a coarse pass that holds the edge of a wall and the ground beside it finds one height, that of the side
with more texture, and the ladders of later passes do not reach the other side. Views from one side agree on that error,
so that nothing later takes it away. Here such pixels climb a ladder over all heights around them, in small tiles: a
window needs its surroundings at its own height, or on its own wall, not at the heights of the pass before.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fields.median import median
from fields.sweep.climbing import MATCHED_NCC, Found, climbing_tiles
from fields.sweep.in_turn import Job, alone
from fields.sweep.stack import ViewStack
from fields.sweep.tiles import Tiles, extent
from fields.sweep.walls import wall_slopes


@dataclass(frozen=True)
class StepSearch:
    """How steps are searched after a pass.

    Attributes
    ----------
    radius : of the NCC window [px]
    step_px : parallax between two rungs [px at the scale of the pass]
    tile_px : side of the tiles that share a ladder [px]: small ones share little, large ones hold heights that few of
        their pixels need
    reach_px : searched are pixels around which heights differ by a parallax of more [px at the scale of the pass]
    around_px : heights this far around a pixel bound its ladder [px at the scale of the pass]
    least_score : views are searched of which half of the pixels scored so high in the pass: windows of this size can
        tell heights in them
    walls : whether vertical walls are tried, beside level ground
    neighbours : how many of the views of the pass heights are compared with, of those that match best
    """

    radius: int
    step_px: float
    tile_px: int
    reach_px: float
    around_px: int
    least_score: float
    walls: bool = False
    neighbours: int = 6


def search_steps(
    stack: ViewStack,
    view: int,
    others: list[int],
    found: Found,
    parallax: float,
    search: StepSearch,
) -> Found:
    """Height, score and curvature of a pass, with those of the search where heights around differ.

    Parameters
    ----------
    stack : ViewStack
    view, others : indices of the reference view and the views it is compared with
    found : height [m], score, curvature [1/m^2], (height, width) float32 each
    parallax : [px/m]
        At the scale of the stack, per metre of height.
    search : StepSearch
    """
    return alone(stack.device, searching_steps(stack, view, others, found, parallax, search))


def searching_steps(
    stack: ViewStack, view: int, others: list[int], found: Found, parallax: float, search: StepSearch
) -> Job[Found]:
    """`search_steps` as a job."""
    height, score = found[0], found[1]
    if min(height.shape) < search.tile_px + 2 * search.radius or median(score) < search.least_score:
        return found
    low, high = _around(height, search.around_px)
    wanted = (high - low) * parallax > search.reach_px
    if not wanted.any():
        return found
    others, step = others[: search.neighbours], search.step_px / parallax
    least = np.full_like(score, MATCHED_NCC)
    size, bounds = search.tile_px, extent(wanted, low, high, search.tile_px)
    level = Tiles.of(wanted, bounds, step, size, search.radius)
    found = yield from _climbed(stack, view, others, found, level, step, least)
    if search.walls:
        width = 2.0 * search.radius + 1.0
        slope = wall_slopes(stack.cameras[view], stack.water, height, wanted, bounds, size, width)
        upright = Tiles.of(wanted, bounds, step, size, search.radius, slope)
        found = yield from _climbed(stack, view, others, found, upright, step, np.maximum(least, found[1]))
    return found


def _climbed(
    stack: ViewStack, view: int, others: list[int], found: Found, tiles: Tiles, step: float, least: np.ndarray
) -> Job[Found]:
    """What was found, and instead what tiles find on ladders of a step [m], where that scores over ``least``."""
    better = [np.array(each) for each in found]

    def take(own: np.ndarray, pixels: np.ndarray, climbed: list[np.ndarray]) -> None:
        keep = own & (climbed[1] > least.ravel()[pixels])
        for target, each in zip(better, climbed, strict=True):
            target.flat[pixels[keep]] = each[keep]

    yield from climbing_tiles(stack, view, others, tiles, lambda part, _: tiles.starts(part), step, take)
    return better[0], better[1], better[2]


def _around(height: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest height within a radius [px] of each pixel, without single wrong ones."""
    kernel = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    height = cv2.medianBlur(height, 3)
    return cv2.erode(height, kernel), cv2.dilate(height, kernel)
