"""Height maps of a block, each with what the others say of it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import cv2
import numpy as np

from fields.median import median
from fields.sweep.bed import trusted
from fields.sweep.block import Block
from fields.sweep.climbing import MATCHED_NCC
from fields.sweep.consistency import comparing
from fields.sweep.in_turn import Job, in_turn
from fields.sweep.lazy import Lazy
from fields.sweep.maps import DepthMap, Keep, Maps
from fields.sweep.planes import continued
from fields.sweep.stack import ViewStack


def fuse(
    block: Block,
    maps: Maps,
    scale: float,
    peers: Mapping[int, list[int]],
    keep: Keep = dict,
    *,
    goes_on: bool = True,
    only: Mapping[int, np.ndarray] | None = None,
) -> Maps:
    """Maps with the mean over the peers that agree as heights, and how many do and how closely; the others are cleared.

    A pixel that no other view confirms takes the median of its surroundings, and where a pass follows (``goes_on``) one
    whose height is not trusted that of the plane through the trusted ones around it, where these lie in one: a better
    start. A pixel that matched nothing confirms nothing either. Maps without peers keep what they have, and so do
    pixels of a view that has ``only`` some others (flat indices).
    """
    fused = keep()
    for m, tolerance, (agreeing, height, spread) in _agreement(block, maps, scale, peers, only or {}):
        height = np.where(agreeing > 0, height, cv2.medianBlur(m.height, 5))
        found = DepthMap(m.view, height, m.score, agreeing, spread.astype(np.float16))
        fused[m.view] = replace(found, height=continued(height, trusted(found), tolerance)) if goes_on else found
    for view in set(maps) - set(fused):
        fused[view] = maps[view]
    maps.clear()
    return fused


def _agreement(
    block: Block, maps: Maps, scale: float, peers: Mapping[int, list[int]], only: Mapping[int, np.ndarray]
) -> Iterator[tuple[DepthMap, float, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
    """Each map that has peers, how close heights [m] have to be to agree, and what `agreement` says of it.

    Of a view that has ``only`` some pixels the others are as in its map.
    """
    chosen = sorted(maps)
    cameras = [block.cameras[v].scaled(scale) if scale != 1.0 else block.cameras[v] for v in chosen]

    def matched(number: int) -> np.ndarray:
        m = maps[chosen[number]]
        return np.where(m.score > MATCHED_NCC, m.height, np.float32(np.nan))

    images = Lazy(matched, len(chosen), (cameras[0].height, cameras[0].width), 1)
    heights = ViewStack.build(block.device, cameras, images, block.water)

    def job(view: int) -> Job[tuple[DepthMap, float, tuple[np.ndarray, np.ndarray, np.ndarray]]]:
        m, others, pixels = maps[view], peers[view], only.get(view)
        tolerance = block.agreement_tolerance(view, others, median(m.height))
        found = yield from comparing(heights, chosen.index(view), [chosen.index(p) for p in others], tolerance, pixels)
        if pixels is not None:
            whole = m.agreeing.copy(), m.height.copy(), m.spread.copy()
            for target, each in zip(whole, found, strict=True):
                target.flat[pixels] = each
            found = whole
        return m, tolerance, found

    yield from in_turn(block.device, (job(view) for view in chosen if peers.get(view)))


def confirm(block: Block, maps: Maps, peers: Mapping[int, list[int]]) -> None:
    """Let heights that stay as they are be confirmed by the others at full size, where these say more than before."""
    if peers:
        for m, _, (agreeing, _, _) in _agreement(block, maps, 1.0, peers, {}):
            maps[m.view] = replace(m, agreeing=np.maximum(m.agreeing, agreeing))
