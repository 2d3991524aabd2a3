"""Refractive plane sweep, coarse to fine: a height per pixel of every matched view.

Heights are measured over the water plane along its normal (over local z = 0 in a dry survey), so that a hypothesis
passes the shoreline without a step. Every pass is one ladder of heights about what the pass before found; from the
second on the ladder follows the relief (`fields.sweep.warping_drjit`), so that windows do not flatten what is already
known.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from fields.sweep.arrays import forget
from fields.sweep.block import Block
from fields.sweep.climbing import MATCHED_NCC, climb_view
from fields.sweep.consistency import agreement
from fields.sweep.lazy import Lazy
from fields.sweep.maps import DepthMap, InOrder, Keep, Maps
from fields.sweep.over_area import Area, columns_over
from fields.sweep.stack import ViewStack
from fields.sweep.steps import StepSearch, search_steps
from fields.sweep.windows import climb_widely_enough

# Height maps that each is compared with where heights are fused.
PEERS = 12
# A pass is finer than a map with so many times its pixels along a side: sizes of halved images are rounded.
_FINER = 1.2
# Rungs of a pass that searches nothing.
REFINING = 3


@dataclass(frozen=True)
class Pass:
    """One ladder over all views.

    Attributes
    ----------
    scale : of the image, 1 is full size
    radius : of the NCC window [px]
    rungs : number of heights tried, odd; None for the first pass, which tries as many as the bound holds
    step_px : parallax between two rungs [px at this scale]
    neighbours : number of views compared with
    fuse : after the pass, average each height with those of the views that agree
    search : after the pass, how heights beyond its ladder are searched; None: not at all
    """

    scale: float
    radius: int
    rungs: int | None
    step_px: float
    neighbours: int
    fuse: bool
    search: StepSearch | None = None

    @property
    def refines(self) -> bool:
        """Whether it tries no more than the heights beside the one that is known: windows of any size tell these."""
        return self.rungs is not None and self.rungs <= REFINING


# Windows shrink as the relief becomes known: 5x5 finds the height, 3x3 about the relief resolves it. docs/sweep.md has
# what other passes give. Windows of the pass before hold heights from 5 px around; images without anything in common
# reach the least scores by chance in one of forty pixels: the better half of eight neighbours on a ladder of forty.
PASSES = (
    Pass(0.25, 2, None, 0.5, 8, False),
    Pass(0.5, 2, 11, 0.4, 8, False, StepSearch(2, 0.5, 16, 2.0, 5, MATCHED_NCC)),
    Pass(1.0, 2, 7, 0.4, 8, True, StepSearch(1, 0.75, 8, 1.6, 3, 0.68, walls=True)),
    Pass(1.0, 2, 5, 0.25, 8, True),
    Pass(1.0, 1, 3, 0.25, 12, True),
)


def passes_from(share: float) -> tuple[Pass, ...]:
    """The passes with the whole bound searched at a share of the size, 1, 0.5 or (as `PASSES`) at most 0.25.

    Images of few pixels have to be searched at more than a quarter of their size (docs/targets.md).
    """
    if share > PASSES[1].scale:
        return (replace(PASSES[2], rungs=None, step_px=PASSES[0].step_px, search=None), *PASSES[3:])
    if share > PASSES[0].scale:
        return (replace(PASSES[1], rungs=None, step_px=PASSES[0].step_px, search=None), *PASSES[2:])
    return PASSES


def sweep(
    block: Block,
    chosen: list[int],
    bound: tuple[float, float],
    progress: Callable[[float], None],
    passes: tuple[Pass, ...] = PASSES,
    area: Area | None = None,
    *,
    before: Mapping[int, DepthMap] | None = None,
    again: Collection[int] = (),
    keep: Keep = dict,
) -> InOrder:
    """Sweep the chosen views, coarse to fine.

    Parameters
    ----------
    block : Block
    chosen : indices of the views that get a depth map
    bound : (low, high) [m] over the water plane
        The ladder of the first pass.
    progress : called with the share done, 0 to 1
        Number of samples (pixels x rungs x compared views) of all passes, which take nearly all of the time.
    passes : tuple of Pass
    area : (x0, y0, x1, y1) [m], local, optional
        Where heights are wanted: other pixels get no height of their own.
    before : mapping of view to DepthMap, optional
        Of an earlier sweep of the same bound, at a smaller scale or the same. Views that have one keep its heights and
        confirm those of the others.
    again : views of ``before``
        That go on from there, with the passes finer than it.
    keep : callable
        Makes the places in which maps are kept meanwhile; default in memory.

    Returns
    -------
    InOrder of DepthMap at the scale of the last pass, in the order of `chosen`
        Views that overlap with no other are left out.
    """
    size = (block.cameras[0].width, block.cameras[0].height)
    maps, widths = keep(), dict[int, int]()
    for view, m in (before or {}).items():
        if view in chosen:
            maps[view], widths[view] = m if view in again else enlarged_map(m, size), m.height.shape[1]
    climbs = [
        climbs_of(block, [v for v in chosen if _climbs(size, p, widths.get(v), v in again)], p, None if n else bound)
        for n, p in enumerate(passes)
    ]
    views = sorted({climb.view for each in climbs for climb in each} | set(widths))
    peers = {view: block.neighbours(view, PEERS, among=views) for view in views}
    climbing = [{climb.view for climb in each} for each in climbs]
    fused = [
        _pixels(block, p) * sum(len(peers[v]) for v in mine) if p.fuse else 0
        for p, mine in zip(passes, climbing, strict=True)
    ]
    total, done = sum(fused) + sum(climb.samples for each in climbs for climb in each), 0
    # By how much the windows of each view are wider than its pass has them [px].
    wider = dict.fromkeys(views, 0)
    for number, p in enumerate(passes):
        for climb in climbs[number]:
            height = maps[climb.view].height if climb.view in maps else None
            maps[climb.view], wider[climb.view] = _climbed(block, p, climb, bound, height, area, wider[climb.view])
            # Ladders of many lengths leave memory of many sizes.
            forget(block.device)
            done += climb.samples
            progress(done / total)
        if fused[number]:
            block.release(p.scale)
            maps = fuse(block, maps, p.scale, {view: peers[view] for view in climbing[number]}, keep)
            done += fused[number]
            progress(done / total)
        if number + 1 == len(passes) or passes[number + 1].scale != p.scale:
            block.release(p.scale)
    confirm(block, maps, {view: peers[view] for view in set(maps) - climbing[-1]})
    return InOrder(maps, [view for view in chosen if view in maps])


def _climbs(size: tuple[int, int], p: Pass, width: int | None, again: bool) -> bool:
    """Whether a view takes part in a pass: one that has a map of some width only if it goes on, in finer passes."""
    return width is None or (again and p.scale * size[0] > _FINER * width)


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
        found.append(Climb(view, others, rungs, _pixels(block, p) * rungs * len(others)))
    return found


def _pixels(block: Block, p: Pass) -> int:
    """Number of pixels of an image at the scale of a pass."""
    camera = block.cameras[0].scaled(p.scale)
    return camera.width * camera.height


def _step(block: Block, p: Pass, view: int, others: list[int], height: float) -> float:
    """Distance [m] between two rungs of a pass about a height [m]."""
    return p.step_px / (p.scale * block.parallax(view, others, height))


def _climbed(
    block: Block,
    p: Pass,
    climb: Climb,
    bound: tuple[float, float],
    before: np.ndarray | None,
    area: Area | None,
    wider: int,
) -> tuple[DepthMap, int]:
    """One pass over one view: the ladder of the bound, or one about the heights of the pass before.

    Windows are by so many pixels ``wider`` than those of the pass, or more where this pass finds that they have to be,
    which is given back.
    """
    stack, view = block.stack(p.scale), climb.view
    middle = 0.5 * (bound[0] + bound[1]) if before is None else float(np.median(before))
    step = _step(block, p, view, climb.others, middle)
    if before is None:
        start = np.full((stack.height, stack.width), bound[0], dtype=np.float32)
    else:
        start = _enlarged(before, stack) - np.float32(step * (climb.rungs // 2))

    def columns(radius: int) -> np.ndarray | None:
        return None if area is None else columns_over(stack.cameras[view], block.water, area, bound, radius)

    climbed = stack, view, climb.others, start, step, climb.rungs
    radius = p.radius + wider
    if p.refines:
        found = climb_view(*climbed, radius, columns(radius))
    else:
        found, radius = climb_widely_enough(*climbed, radius, columns)
    # The search has windows of its own, narrower than those that were too narrow here.
    if p.search is not None and radius == p.radius:
        found = search_steps(stack, view, climb.others, found, p.step_px / step, p.search)
    height, score, _ = found
    nobody = np.zeros(height.shape, dtype=np.uint8)
    spread = np.zeros(height.shape, dtype=np.float16)
    return DepthMap(view, height, score.astype(np.float16), nobody, spread), radius - p.radius


def _enlarged(height: np.ndarray, stack: ViewStack) -> np.ndarray:
    """Heights of a coarser pass at the size of the stack, without the single wrong ones."""
    if height.shape == (stack.height, stack.width):
        return height
    height = cv2.resize(height, (stack.width, stack.height), interpolation=cv2.INTER_LINEAR)
    return cv2.medianBlur(height, 5)


def fuse(block: Block, maps: Maps, scale: float, peers: Mapping[int, list[int]], keep: Keep = dict) -> Maps:
    """Maps with the mean over the peers that agree as heights, and how many do and how closely; the others are cleared.

    A pixel that no other view confirms takes the median of its surroundings: a better start for the next pass. A
    pixel that matched nothing confirms nothing either. Maps without peers keep what they have.
    """
    fused = keep()
    for m, (agreeing, height, spread) in _agreement(block, maps, scale, peers):
        height = np.where(agreeing > 0, height, cv2.medianBlur(m.height, 5))
        fused[m.view] = DepthMap(m.view, height, m.score, agreeing, spread.astype(np.float16))
    for view in set(maps) - set(fused):
        fused[view] = maps[view]
    maps.clear()
    return fused


def _agreement(
    block: Block, maps: Maps, scale: float, peers: Mapping[int, list[int]]
) -> Iterator[tuple[DepthMap, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Each map that has peers, and what `fields.sweep.consistency.agreement` says of it."""
    chosen = sorted(maps)
    cameras = [block.cameras[v].scaled(scale) if scale != 1.0 else block.cameras[v] for v in chosen]

    def matched(number: int) -> np.ndarray:
        m = maps[chosen[number]]
        return np.where(m.score > MATCHED_NCC, m.height, np.float32(np.nan))

    images = Lazy(matched, len(chosen), (cameras[0].height, cameras[0].width), 1)
    heights = ViewStack.build(block.device, cameras, images, block.water)
    for index, view in enumerate(chosen):
        others = peers.get(view)
        if others:
            m = maps[view]
            tolerance = block.agreement_tolerance(view, others, float(np.median(m.height)))
            yield m, agreement(heights, index, [chosen.index(p) for p in others], tolerance)


def confirm(block: Block, maps: Maps, peers: Mapping[int, list[int]]) -> None:
    """Let heights that stay as they are be confirmed by the others at full size, where these say more than before."""
    if peers:
        for m, (agreeing, _, _) in _agreement(block, maps, 1.0, peers):
            maps[m.view] = replace(m, agreeing=np.maximum(m.agreeing, agreeing))


def enlarged_map(m: DepthMap, size: tuple[int, int]) -> DepthMap:
    """A map at another size (width, height), not smaller."""
    if m.height.shape == size[::-1]:
        return m
    height, score, spread = (
        cv2.resize(each.astype(np.float32), size, interpolation=cv2.INTER_LINEAR).astype(each.dtype)
        for each in (m.height, m.score, m.spread)
    )
    agreeing = cv2.resize(m.agreeing, size, interpolation=cv2.INTER_NEAREST)
    return DepthMap(m.view, height, score, agreeing, spread)
