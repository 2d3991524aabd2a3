"""Height maps of a block, each with what the others say of it."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

from fields.sweep.backends import images
from fields.sweep.bed import trusted
from fields.sweep.block import Block
from fields.sweep.consistency import agreement
from fields.sweep.in_turn import Job, in_turn
from fields.sweep.lazy import Lazy
from fields.sweep.maps import DepthMap, Keep, Maps
from fields.sweep.passes import MATCHED_NCC
from fields.sweep.stack import ViewStack

# What `fields.sweep.consistency.agreement` gives: images of `fields.sweep.backends.images`.
_Agreement = tuple[Any, Any, Any]
# A height that no other view confirms is replaced by the median over a square of this side [px].
_SURROUNDINGS_PX = 5


def fuse(
    block: Block,
    maps: Maps,
    scale: float,
    peers: Mapping[int, list[int]],
    keep: Keep = dict,
    *,
    goes_on: bool = True,
    only: Mapping[int, Any] | None = None,
) -> Maps:
    """Maps with the mean over the peers that agree as heights, and how many do and how closely; the others are cleared.

    A pixel that no other view confirms takes the median of its surroundings, and where a pass follows (``goes_on``) one
    whose height is not trusted that of the plane through the trusted ones around it, where these lie in one: a better
    start. A pixel that matched nothing confirms nothing either. Maps without peers keep what they have, and so do
    pixels of a view that has ``only`` some others (flat indices).
    """
    fused, beside = keep(), images(block.device)
    for m, tolerance, (agreeing, height, spread) in _agreement(block, maps, scale, peers, only or {}):
        height = beside.where(agreeing > 0, height, beside.median_blur(m.height, _SURROUNDINGS_PX))
        found = DepthMap(m.view, height, m.score, agreeing, beside.brief(spread))
        if goes_on:
            found = replace(found, height=beside.on_planes(height, trusted(found), tolerance))
        fused[m.view] = found
    for view in set(maps) - set(fused):
        fused[view] = maps[view]
    maps.clear()
    return fused


def _agreement(
    block: Block, maps: Maps, scale: float, peers: Mapping[int, list[int]], only: Mapping[int, Any]
) -> Iterator[tuple[DepthMap, float, _Agreement]]:
    """Each map that has peers, how close heights [m] have to be to agree, and what `agreement` says of it.

    Of a view that has ``only`` some pixels the others are as in its map.
    """
    chosen, beside = sorted(maps), images(block.device)
    cameras = [block.cameras[v].scaled(scale) if scale != 1.0 else block.cameras[v] for v in chosen]

    def matched(number: int) -> Any:
        m = maps[chosen[number]]
        return beside.where(m.score > MATCHED_NCC, m.height, math.nan)

    surfaces = Lazy(matched, len(chosen), (cameras[0].height, cameras[0].width), 1)
    heights = ViewStack.build(block.device, cameras, surfaces, block.water)

    def job(view: int) -> Job[tuple[DepthMap, float, _Agreement]]:
        m, others, pixels = maps[view], peers[view], only.get(view)
        tolerance = block.agreement_tolerance(view, others, beside.median(m.height))
        found = yield from agreement(heights, chosen.index(view), [chosen.index(p) for p in others], tolerance, pixels)
        if pixels is not None:
            whole = [beside.flat_copy(each) for each in (m.agreeing, m.height, m.spread)]
            for target, each in zip(whole, found, strict=True):
                beside.put(target, pixels, each)
            found = tuple(beside.shaped(each, m.height.shape) for each in whole)
        return m, tolerance, found

    yield from in_turn(block.device, (job(view) for view in chosen if peers.get(view)))


def confirm(block: Block, maps: Maps, peers: Mapping[int, list[int]]) -> None:
    """Let heights that stay as they are be confirmed by the others at full size, where these say more than before."""
    if peers:
        for m, _, (agreeing, _, _) in _agreement(block, maps, 1.0, peers, {}):
            maps[m.view] = replace(m, agreeing=images(block.device).larger(m.agreeing, agreeing))
