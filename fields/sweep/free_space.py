"""Is the way to a point free? Heights through which other views see the bed are not trusted."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fields.median import median
from fields.sweep.arrays import host
from fields.sweep.backends import kernels
from fields.sweep.bed import trusted
from fields.sweep.block import Block
from fields.sweep.lazy import Lazy
from fields.sweep.maps import DepthMap, InOrder, Keep
from fields.sweep.stack import ViewStack
from fields.sweep.sweep import PEERS


def without_contradicted(block: Block, maps: Sequence[DepthMap], keep: Keep = dict) -> InOrder:
    """Maps in which heights count as confirmed by no view if at least as many look through them as confirm them.

    A view looks through a point where its own trusted heights, in all four pixels about the point, are lower by more
    than what counts as agreement. Beside an edge views from one side may err alike; those from the other side see what
    lies behind.

    Parameters
    ----------
    block : Block
    maps : sequence of DepthMap
        Of `fields.sweep.sweep.sweep`.
    keep : callable
        Makes the place for what is returned.
    """
    chosen, found = [m.view for m in maps], keep()
    cameras = [block.cameras[view] for view in chosen]

    def heights(number: int) -> np.ndarray:
        m = maps[number]
        return np.where(trusted(m), m.height, np.float32(np.nan))

    images = Lazy(heights, len(chosen), (cameras[0].height, cameras[0].width), 1)
    stack = ViewStack.build(block.device, cameras, images, block.water)
    for index, m in enumerate(maps):
        peers = block.neighbours(m.view, PEERS, among=chosen)
        if not peers:
            found[m.view] = m
            continue
        tolerance = block.agreement_tolerance(m.view, peers, median(m.height))
        through = kernels(block.device).looked_through(stack, index, [chosen.index(peer) for peer in peers], tolerance)
        against = host(block.device, through).reshape(m.height.shape)
        contradicted = (against > 0.0) & (against >= m.agreeing)
        found[m.view] = replace(m, agreeing=np.where(contradicted, 0, m.agreeing).astype(np.uint8))
    return InOrder(found, chosen)
