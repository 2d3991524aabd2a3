"""Steps of the bed: where the heights around a pixel differ by more than a ladder reaches, all between them are tried.

The window of a coarse pass that holds the edge of a wall and the ground beside it finds one height, that of the side
with more texture, and the ladders of later passes do not reach the other side. Views from one side agree on that error,
so that nothing later takes it away. Here such pixels climb a ladder over all heights around them, in small tiles: a
window needs its surroundings at its own height, or on its own wall, not at the heights of the pass before.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from fields.sweep.backends import images
from fields.sweep.climbing import MATCHED_NCC, Found, climbing_tiles
from fields.sweep.in_turn import Job, alone
from fields.sweep.stack import ViewStack
from fields.sweep.tiles import Tiles
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
    beside = images(stack.device)
    height, score, curvature = (beside.placed(stack.device, each) for each in found)
    job = searching_steps(stack, view, others, (height, score, curvature), parallax, search)
    height, score, curvature = (beside.fetched(each) for each in alone(stack.device, job))
    return height, score, curvature


def searching_steps(
    stack: ViewStack, view: int, others: list[int], found: Found, parallax: float, search: StepSearch
) -> Job[Found]:
    """`search_steps` as a job."""
    height, score, beside = found[0], found[1], images(stack.device)
    if min(height.shape) < search.tile_px + 2 * search.radius or beside.median(score) < search.least_score:
        return found
    low, high = beside.around(height, search.around_px)
    wanted = beside.rising(low, high, parallax, search.reach_px)
    if not beside.is_any(wanted):
        return found
    others, step = others[: search.neighbours], search.step_px / parallax
    least = beside.full(stack.device, height.shape, MATCHED_NCC)
    size, bounds = search.tile_px, beside.extent(wanted, low, high, search.tile_px)
    level = Tiles.of(wanted, bounds, step, size, search.radius)
    found = yield from _climbed(stack, view, others, found, level, step, least)
    if search.walls:
        width, ways = 2.0 * search.radius + 1.0, beside.ways(height, wanted, size)
        slope = wall_slopes(stack.cameras[view], stack.water, ways, bounds, size, width)
        upright = Tiles.of(wanted, bounds, step, size, search.radius, slope)
        found = yield from _climbed(stack, view, others, found, upright, step, beside.larger(least, found[1]))
    return found


def _climbed(
    stack: ViewStack, view: int, others: list[int], found: Found, tiles: Tiles, step: float, least: Any
) -> Job[Found]:
    """What was found, and instead what tiles find on ladders of a step [m], where that scores over ``least``."""
    beside = images(stack.device)
    better, worse = [beside.flat_copy(each) for each in found], beside.pixels_of(least)

    def take(own: Any, pixels: Any, climbed: list[Any]) -> None:
        keep = own & (climbed[1] > beside.at(worse, pixels))
        for target, each in zip(better, climbed, strict=True):
            beside.put(target, pixels, each, keep)

    def starts(part: slice, _pixels: Any) -> Any:
        return beside.tile_starts(stack.device, tiles, part)

    yield from climbing_tiles(stack, view, others, tiles, starts, step, take)
    height, score, curvature = (beside.shaped(each, found[0].shape) for each in better)
    return height, score, curvature
