"""One pass over one view."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from fields.sweep.backends import images
from fields.sweep.block import Block
from fields.sweep.climbing import MATCHED_NCC, climbing_tiles, climbing_view
from fields.sweep.in_turn import Job
from fields.sweep.maps import DepthMap
from fields.sweep.over_area import Area, columns_over
from fields.sweep.passes import Pass
from fields.sweep.steps import searching_steps
from fields.sweep.tiles import PART_SIDE_PX, Tiles
from fields.sweep.windows import LEAST_KNOWN, climbing_widely_enough


@dataclass(frozen=True)
class Climb:
    """What one pass does for one view.

    Attributes
    ----------
    view : index of the view
    others : indices of the views that it is compared with
    rungs : number of heights tried
    samples : pixels x rungs x others
    """

    view: int
    others: list[int]
    rungs: int
    samples: int


def climbs_of(block: Block, chosen: list[int], p: Pass, bound: tuple[float, float] | None) -> list[Climb]:
    """What a pass does for each of the chosen views; those that overlap with no other are left out.

    The ladder reaches over the bound (low, high) [m], or has the rungs of the pass where that is None.
    """
    found = []
    for view in chosen:
        others = block.neighbours(view, p.neighbours)
        if not others:
            continue
        if bound is not None:
            step = _step(block, p, view, others, 0.5 * (bound[0] + bound[1]))
            rungs = int(np.ceil((bound[1] - bound[0]) / step)) + 1
        elif p.rungs is not None:
            rungs = p.rungs
        else:
            raise ValueError("a pass after the first expects its own number of rungs, got None")
        found.append(Climb(view, others, rungs, pixels_of(block, p) * rungs * len(others)))
    return found


def pixels_of(block: Block, p: Pass) -> int:
    """Number of pixels of an image at the scale of a pass."""
    camera = block.cameras[0].scaled(p.scale)
    return camera.width * camera.height


def _step(block: Block, p: Pass, view: int, others: list[int], height: float) -> float:
    """Distance [m] between two rungs of a pass about a height [m]."""
    return p.step_px / (p.scale * block.parallax(view, others, height))


def climbing(
    block: Block,
    p: Pass,
    climb: Climb,
    bound: tuple[float, float],
    before: DepthMap | None,
    area: Area | None,
    wider: int,
) -> Job[tuple[DepthMap, int]]:
    """One pass over one view: the ladder of the bound, or one about the heights of the pass before.

    Windows are by so many pixels ``wider`` than those of the pass, or more where this pass finds that they have to be,
    which is given back.
    """
    stack, view, beside = block.stack(p.scale), climb.view, images(block.device)
    shape = (stack.height, stack.width)
    middle = 0.5 * (bound[0] + bound[1]) if before is None else beside.median(before.height)
    step = _step(block, p, view, climb.others, middle)
    if before is None:
        start = beside.full(block.device, shape, bound[0])
    else:
        start = beside.lowered(beside.enlarged(before.height, shape), step * (climb.rungs // 2))

    def columns(radius: int) -> np.ndarray | None:
        return None if area is None else columns_over(stack.cameras[view], block.water, area, bound, radius)

    ladder = stack, view, climb.others, start, step, climb.rungs
    radius = p.radius + wider
    least_known = _least_known(block)
    if p.refines:
        found = yield from climbing_view(*ladder, radius, columns(radius), least_known)
    else:
        found, radius = yield from climbing_widely_enough(*ladder, radius, columns, least_known)
    # The search has windows of its own, narrower than those that were too narrow here.
    if p.search is not None and radius == p.radius:
        found = yield from searching_steps(stack, view, climb.others, found, p.step_px / step, p.search)
    height, score, _ = found
    return beside.found_map(view, height, _of_shown(block, p, view, score)), radius - p.radius


def refining(block: Block, p: Pass, climb: Climb, before: DepthMap, part: np.ndarray) -> Job[tuple[DepthMap, Any]]:
    """One pass over a part of a view, (height, width) bool at a share of the size, and the pixels that it took, flat.

    Those are of all tiles that hold some of the part; the others stay as they were ``before``.
    """
    stack, view, beside = block.stack(p.scale), climb.view, images(block.device)
    step = _step(block, p, view, climb.others, beside.median(before.height))
    tiles = Tiles.over(part, before.height.shape, PART_SIDE_PX - 2 * p.radius, p.radius, climb.rungs)
    tiles = replace(tiles, wanted=beside.placed(block.device, tiles.wanted))
    height, score = beside.flat_copy(before.height), beside.flat_copy(before.score)
    first = beside.pixels_of(beside.lowered(before.height, step * (climb.rungs // 2)))

    def take(own: Any, pixels: Any, climbed: list[Any]) -> None:
        found, scored, _ = climbed
        beside.put(height, pixels, found, own & (scored > MATCHED_NCC))
        beside.put(score, pixels, scored, own)

    least_known = _least_known(block)
    yield from climbing_tiles(
        stack, view, climb.others, tiles, lambda _, pixels: beside.at(first, pixels), step, take, least_known
    )
    height, score = (beside.shaped(each, (stack.height, stack.width)) for each in (height, score))
    taken = beside.places_of(tiles.wanted)
    return replace(before, height=height, score=_of_shown(block, p, view, score)), taken


def _of_shown(block: Block, p: Pass, view: int, score: Any) -> Any:
    """The scores, -1 at pixels left out of the photograph: these show nothing, however much around them is known."""
    if p.scale < 1.0 or block.images.are_whole:
        return score
    return images(block.device).shown(block.device, block.images[view], score)


def _least_known(block: Block) -> float:
    return 1.0 if block.images.are_whole else LEAST_KNOWN
