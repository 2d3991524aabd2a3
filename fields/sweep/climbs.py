"""One pass over one view."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np

from fields.median import median
from fields.sweep.block import Block
from fields.sweep.climbing import MATCHED_NCC, climbing_tiles, climbing_view
from fields.sweep.in_turn import Job
from fields.sweep.maps import DepthMap
from fields.sweep.over_area import Area, columns_over
from fields.sweep.passes import Pass
from fields.sweep.stack import ViewStack
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
    stack, view = block.stack(p.scale), climb.view
    middle = 0.5 * (bound[0] + bound[1]) if before is None else median(before.height)
    step = _step(block, p, view, climb.others, middle)
    if before is None:
        start = np.full((stack.height, stack.width), bound[0], dtype=np.float32)
    else:
        start = _enlarged(before.height, stack) - np.float32(step * (climb.rungs // 2))

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
    score = _of_shown(block, p, view, score)
    nobody = np.zeros(height.shape, dtype=np.uint8)
    spread = np.zeros(height.shape, dtype=np.float16)
    return DepthMap(view, height, score.astype(np.float16), nobody, spread), radius - p.radius


def refining(
    block: Block, p: Pass, climb: Climb, before: DepthMap, part: np.ndarray
) -> Job[tuple[DepthMap, np.ndarray]]:
    """One pass over a part of a view, (height, width) bool at a share of the size, and the pixels that it took, flat.

    Those are of all tiles that hold some of the part; the others stay as they were ``before``.
    """
    stack, view = block.stack(p.scale), climb.view
    step = _step(block, p, view, climb.others, median(before.height))
    tiles = Tiles.over(part, before.height.shape, PART_SIDE_PX - 2 * p.radius, p.radius, climb.rungs)
    height, score = before.height.copy(), before.score.copy()
    first = before.height.ravel() - np.float32(step * (climb.rungs // 2))

    def take(own: np.ndarray, pixels: np.ndarray, climbed: list[np.ndarray]) -> None:
        found, scored, _ = climbed
        matched = own & (scored > MATCHED_NCC)
        height.flat[pixels[matched]] = found[matched]
        score.flat[pixels[own]] = scored[own]

    least_known = _least_known(block)
    yield from climbing_tiles(
        stack, view, climb.others, tiles, lambda _, pixels: first[pixels], step, take, least_known
    )
    return replace(before, height=height, score=_of_shown(block, p, view, score)), np.flatnonzero(tiles.wanted)


def _of_shown(block: Block, p: Pass, view: int, score: np.ndarray) -> np.ndarray:
    """The scores, -1 at pixels left out of the photograph: these show nothing, however much around them is known."""
    if p.scale < 1.0 or block.images.are_whole:
        return score
    return np.where(np.isnan(block.images[view]), score.dtype.type(-1.0), score)


def _least_known(block: Block) -> float:
    return 1.0 if block.images.are_whole else LEAST_KNOWN


def _enlarged(height: np.ndarray, stack: ViewStack) -> np.ndarray:
    """Heights of a coarser pass at the size of the stack, without the single wrong ones."""
    if height.shape == (stack.height, stack.width):
        return height
    height = cv2.resize(height, (stack.width, stack.height), interpolation=cv2.INTER_LINEAR)
    return cv2.medianBlur(height, 5)
