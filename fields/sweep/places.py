"""Places in plan of the pixels of a height map."""

from __future__ import annotations

import numpy as np

from fields.sweep.block import Block
from fields.sweep.kernels.arrays import floats, host
from fields.sweep.kernels.backend import kernels
from fields.sweep.kernels.rays import point_at
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap


def places_in_plan(block: Block, m: HeightMap) -> np.ndarray:
    """Places (height, width, 2) float32 [m], local, of the points that a height map shows."""
    stack = ViewStack.build(block.device, [block.cameras[m.view]], [m.height], block.water, block.skips)
    rays = kernels(block.device).rays_of_rows(stack, 0, 0, stack.height)
    points = point_at(rays, floats(block.device, m.height))
    in_frame = np.stack([host(block.device, each) for each in points])
    water = stack.kernel_water
    xy = (water.from_local.T[:2] @ in_frame).T + water.origin[:2]
    return xy.astype(np.float32).reshape(*m.height.shape, 2)
