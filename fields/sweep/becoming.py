"""Which pixels of the height maps become points of the bed: the others only confirm, and need no finer passes.

Every piece of the bed is taken once, from the steepest view that shows it (`fields.sweep.bed.unique_pixels`), so that
of the pixels of all maps one in ten or twenty becomes a point. Before the passes that refine, this is predicted at a
quarter of the size.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from fields.sweep.backends import images, kernels
from fields.sweep.bed import trusted
from fields.sweep.block import Block
from fields.sweep.footprint import Footprint
from fields.sweep.lazy import Lazy
from fields.sweep.maps import DepthMap
from fields.sweep.stack import ViewStack
from fields.sweep.tiles import PART_SIDE_PX

# Of the maps: what is looked at has four pixels along each side.
_SCALE = 0.25


def becoming_points(block: Block, maps: Mapping[int, DepthMap]) -> dict[int, np.ndarray]:
    """Which parts of each view are to become points, (height, width) bool at a quarter of the size.

    They have trusted pixels, and no steeper view has trusted ones that agree with them. Empty where images are smaller
    than a tile of `fields.sweep.tiles.PART_SIDE_PX`: there are no parts of these.
    """
    if min(min(camera.width, camera.height) for camera in block.cameras) < PART_SIDE_PX:
        return {}
    order = sorted(maps, key=lambda view: block.cameras[view].cam_from_local[2][2])
    cameras = [block.cameras[view].scaled(_SCALE) for view in order]
    beside, shape = images(block.device), (cameras[0].height, cameras[0].width)

    def trusted_heights(m: DepthMap) -> Any:
        """Mean of the trusted heights in each part of a map [m]; NaN without any."""
        return beside.means_of(m.height, trusted(m), shape)

    known = {view: trusted_heights(maps[view]) for view in order}
    extents = {view: beside.extremes(height) for view, height in known.items()}
    ground = {
        view: Footprint.of(camera, block.water, extent)
        for camera, (view, extent) in zip(cameras, extents.items(), strict=True)
        if extent is not None
    }
    heights = ViewStack.build(
        block.device, cameras, Lazy(lambda number: known[order[number]], len(order), shape, 1), block.water
    )
    wanted = {}
    for number, view in enumerate(order):
        against = None
        steeper = [
            n for n in range(number) if view in ground and order[n] in ground and ground[view].meets(ground[order[n]])
        ]
        middle = beside.median_above(known[view], -math.inf) if steeper else None
        if middle is not None:
            tolerance = block.agreement_tolerance(view, block.neighbours(view, 8, among=order), middle)
            against, _, _ = kernels(block.device).compare(heights, number, steeper, tolerance)
        wanted[view] = beside.first_shown(block.device, known[view], against)
    return wanted
