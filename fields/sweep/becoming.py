"""Which pixels of the height maps become points of the bed: the others only confirm, and need no finer passes.

Every piece of the bed is taken once, from the steepest view that shows it (`fields.sweep.bed.unique_pixels`), so that
of the pixels of all maps one in ten or twenty becomes a point. Before the passes that refine, this is predicted at a
quarter of the size.
"""

from __future__ import annotations

from collections.abc import Mapping

import cv2
import numpy as np

from fields.median import median
from fields.sweep.arrays import host
from fields.sweep.backends import warping
from fields.sweep.bed import trusted
from fields.sweep.block import Block
from fields.sweep.footprint import Footprint
from fields.sweep.lazy import Lazy
from fields.sweep.maps import DepthMap
from fields.sweep.stack import ViewStack
from fields.sweep.tiles import PART_SIDE_PX

# Of the maps: what is looked at has four pixels along each side.
_SCALE = 0.25
# What lies beside it is refined, too.
_AROUND = np.ones((3, 3), dtype=np.uint8)


def becoming_points(block: Block, maps: Mapping[int, DepthMap]) -> dict[int, np.ndarray]:
    """Which parts of each view are to become points, (height, width) bool at a quarter of the size.

    They have trusted pixels, and no steeper view has trusted ones that agree with them. Empty where images are smaller
    than a tile of `fields.sweep.tiles.PART_SIDE_PX`: there are no parts of these.
    """
    if min(min(camera.width, camera.height) for camera in block.cameras) < PART_SIDE_PX:
        return {}
    order = sorted(maps, key=lambda view: block.cameras[view].cam_from_local[2][2])
    cameras = [block.cameras[view].scaled(_SCALE) for view in order]
    size = cameras[0].width, cameras[0].height
    known = {view: _trusted_heights(maps[view], size) for view in order}
    ground = {
        view: Footprint.of(camera, block.water, (float(np.nanmin(height)), float(np.nanmax(height))))
        for view, camera, height in zip(order, cameras, known.values(), strict=True)
        if np.isfinite(height).any()
    }
    heights = ViewStack.build(
        block.device, cameras, Lazy(lambda number: known[order[number]], len(order), size[::-1], 1), block.water
    )
    wanted = {}
    for number, view in enumerate(order):
        there = np.isfinite(known[view])
        steeper = [
            n for n in range(number) if view in ground and order[n] in ground and ground[view].meets(ground[order[n]])
        ]
        if steeper:
            others = block.neighbours(view, 8, among=order)
            tolerance = block.agreement_tolerance(view, others, median(known[view][there]))
            count, _, _ = warping(block.device).compare(heights, number, steeper, tolerance)
            there &= host(block.device, count).reshape(there.shape) == 0.0
        wanted[view] = cv2.dilate(there.astype(np.uint8), _AROUND).astype(bool)
    return wanted


def _trusted_heights(m: DepthMap, size: tuple[int, int]) -> np.ndarray:
    """Mean of the trusted heights in each part of a map, (height, width) float32 [m]; NaN without any."""
    known = trusted(m).astype(np.float32)
    share, total = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (known, known * m.height))
    return np.where(share > 0.0, total / np.maximum(share, 1e-6), np.float32(np.nan)).astype(np.float32)
