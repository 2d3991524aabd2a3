"""Fusion of the height maps of a block: agreement with other views, means over them, violations of free space."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import repeat

import cv2
import numpy as np

from fields.sweep.block import Block
from fields.sweep.images import extrapolate_planes, median
from fields.sweep.kernels.arrays import Job, Launch, host, run_jobs
from fields.sweep.kernels.rays import compare_heights, count_seeing_through
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap, Maps, OrderedMaps, StoreFactory, trusted, views_of
from fields.sweep.matching import MATCHED_NCC

_Agreement = tuple[np.ndarray, np.ndarray, np.ndarray]  # Number of agreeing peers, fused heights and their spread
PEERS = 12  # Number of height maps that each is compared with
_SURROUNDINGS_PX = 5  # A height that no other view confirms is replaced by the median over a square of this side [px]


@dataclass(frozen=True)
class ComparedViews:
    """Views that the map of a view is compared with, and its compared pixels (flat indices; None for all)."""

    peers: list[int]
    pixels: np.ndarray | None = None


def fuse(
    block: Block,
    maps: Maps,
    scale: float,
    compared: Mapping[int, ComparedViews],
    make_store: StoreFactory = dict,
    *,
    is_intermediate: bool = True,
) -> Maps:
    """Fused maps: mean height over the peers that agree, their number and spread; the input is emptied.

    A pixel that no other view confirms takes the median of its surroundings. Where a pass follows
    (``is_intermediate``), one whose height is not trusted takes that of the plane through the trusted ones around it,
    where these lie in one: a better start. A pixel that matched nothing confirms nothing either. Maps that are not
    compared keep what they have.
    """
    fused = make_store()
    for m, tolerance, (agreeing, height, spread) in _agreement(block, maps, scale, compared):
        height = np.where(agreeing > 0, height, cv2.medianBlur(m.height, _SURROUNDINGS_PX))
        found = HeightMap(m.view, height, m.score, agreeing, spread.astype(np.float16))
        if is_intermediate:
            found = replace(found, height=extrapolate_planes(height, trusted(found), tolerance))
        fused[m.view] = found
    for view in set(maps) - set(fused):
        fused[view] = maps[view]
    maps.clear()
    return fused


def _agreement(
    block: Block, maps: Maps, scale: float, compared: Mapping[int, ComparedViews]
) -> Iterator[tuple[HeightMap, float, _Agreement]]:
    """Maps that are compared, each with the tolerance [m] and its `agreement`.

    Where only some pixels of a view are compared, the others keep the values of its map.
    """
    chosen = sorted(maps)
    cameras = [block.cameras[v].scaled(scale) if scale != 1.0 else block.cameras[v] for v in chosen]

    def matched(number: int) -> np.ndarray:
        m = maps[chosen[number]]
        return np.where(m.score > MATCHED_NCC, m.height, np.float32(np.nan))

    heights = ViewStack.lazy(block.device, cameras, matched, block.water)

    def job(view: int) -> Job[tuple[HeightMap, float, _Agreement]]:
        m, others, pixels = maps[view], compared[view].peers, compared[view].pixels
        tolerance = block.agreement_tolerance(view, others, median(m.height))
        found = yield from agreement(heights, chosen.index(view), [chosen.index(p) for p in others], tolerance, pixels)
        if pixels is not None:
            full_maps = [each.flatten() for each in (m.agreeing, m.height, m.spread)]
            for target, each in zip(full_maps, found, strict=True):
                target[pixels] = each
            count, height, spread = (each.reshape(m.height.shape) for each in full_maps)
            found = count, height, spread
        return m, tolerance, found

    yield from run_jobs(block.device, (job(view) for view in chosen if view in compared and compared[view].peers))


def agreement(
    heights: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray | None = None
) -> Job[_Agreement]:
    """Agreement of the height map of one view with those of its peers.

    The bed point of each pixel is projected into each peer, whose own height there (bilinear) is compared. ``heights``:
    a stack of height maps [m] over the water plane. ``view``, ``peers``: indices into the stack. ``tolerance`` [m]:
    heights closer than this agree. ``pixels`` (P,) flat indices, optional: of the view; all of them by default. Returns
    ``agreeing`` (height, width) uint8, or (P,): number of peers that agree; ``fused`` float32 [m]: mean of the view's
    own height and those that agree; ``spread`` float32 [m]: standard deviation (population) of the same.
    """
    own = heights.images[view] if pixels is None else heights.images[view].ravel()[pixels]

    def launch() -> Launch:
        return Launch(list(compare_heights(heights, view, peers, tolerance, pixels)))

    sums = yield launch
    count, total, square = (each.reshape(own.shape) for each in sums)
    mean = total / (count + 1.0)
    spread = np.sqrt(np.maximum(square / (count + 1.0) - mean * mean, 0.0))
    return count.astype(np.uint8), own + mean, spread


def num_comparable(block: Block, maps: Sequence[HeightMap]) -> Iterator[np.ndarray | None]:
    """Number of peers (height, width), for each map, that show the point of a pixel neither masked nor white.

    It is infinite where no peer shows the point masked or white, and None where no photograph of a peer is so anywhere.
    """
    if block.images.are_unmasked:
        yield from repeat(None, len(maps))
        return
    chosen = views_of(maps)
    cameras = [block.cameras[view] for view in chosen]

    def shown(number: int) -> np.ndarray:
        return np.where(np.isnan(block.images[chosen[number]]), np.float32(np.nan), maps[number].height)

    inside, unmasked = (
        ViewStack.lazy(block.device, cameras, make, block.water) for make in (lambda number: maps[number].height, shown)
    )
    for index, m in enumerate(maps):
        peers = block.neighbours(m.view, PEERS, candidates=chosen)
        if not any(block.images.is_masked(peer) for peer in peers):
            yield None
            continue
        numbers = [chosen.index(peer) for peer in peers]
        of_all, of_unmasked = (
            host(block.device, compare_heights(stack, index, numbers, math.inf)[0]) for stack in (inside, unmasked)
        )
        yield np.where(of_unmasked < of_all, of_unmasked, np.float32(np.inf)).reshape(m.height.shape)


def remove_free_space_violations(
    block: Block, maps: Sequence[HeightMap], make_store: StoreFactory = dict
) -> OrderedMaps:
    """Maps in which heights are unconfirmed where as many views see through them (free space) as confirm them.

    A view sees through a point where its own trusted heights, in all four pixels about the point, are lower by more
    than what counts as agreement. Beside an edge views from one side may err alike; those from the other side see what
    lies behind. ``maps``: of `fields.sweep.sweep.sweep`. ``make_store``: factory of the store of the maps returned.
    """
    chosen, found = views_of(maps), make_store()
    cameras = [block.cameras[view] for view in chosen]

    def heights(number: int) -> np.ndarray:
        m = maps[number]
        return np.where(trusted(m), m.height, np.float32(np.nan))

    stack = ViewStack.lazy(block.device, cameras, heights, block.water)
    for index, m in enumerate(maps):
        peers = block.neighbours(m.view, PEERS, candidates=chosen)
        pixels = np.flatnonzero(trusted(m))
        if not peers or not len(pixels):
            found[m.view] = m
            continue
        tolerance = block.agreement_tolerance(m.view, peers, median(m.height))
        through = count_seeing_through(stack, index, [chosen.index(peer) for peer in peers], tolerance, pixels)
        against, agreeing = host(block.device, through), np.array(m.agreeing)
        contradicted = (against > 0.0) & (against >= agreeing.flat[pixels])
        agreeing.flat[pixels[contradicted]] = 0
        found[m.view] = replace(m, agreeing=agreeing)
    return OrderedMaps(found, chosen)
