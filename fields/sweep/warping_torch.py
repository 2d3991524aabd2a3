"""Images carried along bent paths, in torch: the twin of `fields.sweep.warping_drjit` where Dr.Jit does not run.

The same functions with the same signatures and shapes (K neighbours, J rungs, P pixels of a strip, flat). Torch
computes step by step, so samples are taken in portions that stay in the processor's cache.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fields.sweep.arrays import indices
from fields.sweep.legs import legs_through, seen_at
from fields.sweep.stack import Beyond, ViewStack, camera_table

# Samples (neighbours x rungs x pixels) of one strip: 32 MB an array.
STRIP_SAMPLES = 8_000_000
# Samples that one operation takes on: 1 MB an array.
PORTION = 250_000


def pixels_of(stack: ViewStack, view: int, first_row: int, rows: int) -> Tensor:
    """A strip of rows of the image of `view`: P = rows * width values."""
    first = (view * stack.height + first_row) * stack.width
    return stack.pixels[first : first + rows * stack.width]


def legs_of(stack: ViewStack, view: int, first_row: int, rows: int) -> list[Tensor]:
    """Legs (see `fields.sweep.legs`) of a strip of pixels of `view`: nine tensors of P = rows * width."""
    place = stack.device.place
    row = torch.arange(rows, dtype=torch.float32, device=place) + (first_row + 0.5)
    column = torch.arange(stack.width, dtype=torch.float32, device=place) + 0.5
    v, u = torch.meshgrid(row, column, indexing="ij")
    cameras = [stack.cameras[view]]
    beyond = Beyond.of(cameras)
    camera = [float(c) for c in camera_table(cameras, beyond)[0]]
    return legs_through(camera, u.reshape(-1), v.reshape(-1), stack.plane, beyond)


def project_at(stack: ViewStack, legs, z: Tensor, pixel, view):
    """Pixel position in `view`, and whether inside it, of the path of `pixel` at height `z`.

    `pixel` indexes the legs: a tensor, or ``...`` for all of them against the last axis of `z`. `view` is a number or
    a tensor of them.
    """
    own = [row[pixel] for row in legs]
    camera = stack.table.reshape(-1, stack.beyond.row)[view].unbind(-1)
    return seen_at(camera, own, z, None if stack.water is None else stack.plane, stack.beyond)


def _corner(stack: ViewStack, u: Tensor, v: Tensor, inside: Tensor):
    """Index within its image of the upper left of the four pixels about (u, v), and the way from there [px]."""
    x, y = torch.where(inside, u - 0.5, 0.0), torch.where(inside, v - 0.5, 0.0)
    x0, y0 = x.long(), y.long()
    return y0 * stack.width + x0, x - x0, y - y0


def sample(stack: ViewStack, view, u: Tensor, v: Tensor, inside: Tensor) -> Tensor:
    """Bilinear lookup in image `view` at pixel position (u, v); NaN where not inside."""
    corner, fx, fy = _corner(stack, u, v, inside)
    corner = corner + view * (stack.width * stack.height)

    def between(offset: int) -> Tensor:
        left = stack.pixels[corner + offset]
        return torch.addcmul(left, fx, stack.pixels[corner + (offset + 1)] - left)

    top = between(0)
    values = torch.addcmul(top, fy, between(stack.width) - top)
    return torch.where(inside, values, torch.nan)


def warp(stack: ViewStack, legs, start: Tensor, neighbours: Tensor, step: float, rungs: int) -> Tensor:
    """Neighbour intensities W at (k, j, p), flat, K * J * P; NaN outside the neighbour's image."""
    values = start.new_empty(len(neighbours), rungs, len(start))
    ladder = torch.arange(rungs, dtype=torch.float32, device=start.device)
    per_call = max(1, PORTION // len(start))
    for first in range(0, rungs, per_call):
        z = start + float(step) * ladder[first : first + per_call, None]
        for k, view in enumerate(neighbours.tolist()):
            u, v, inside = project_at(stack, legs, z, ..., view)
            values[k, first : first + per_call] = sample(stack, view, u, v, inside)
    return values.reshape(-1)


def compare(stack: ViewStack, view: int, peers: list[int], tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Count, sum and sum of squares (P) of the differences below `tolerance`; see the twin."""
    legs, own = legs_of(stack, view, 0, stack.height), pixels_of(stack, view, 0, stack.height)
    count, total, square = torch.zeros_like(own), torch.zeros_like(own), torch.zeros_like(own)
    for peer in peers:
        difference = sample(stack, peer, *project_at(stack, legs, own, ..., peer)) - own
        near = difference.abs() < tolerance
        difference = torch.where(near, difference, 0.0)
        count += near
        total += difference
        square += difference * difference
    return count, total, square


def paths_of(stack: ViewStack, view: int, pixels: np.ndarray) -> tuple[list[Tensor], Tensor]:
    """Legs of chosen pixels (flat indices) of a view, and their heights in a stack of height maps."""
    chosen = indices(stack.device, pixels)
    legs = [row[chosen] for row in legs_of(stack, view, 0, stack.height)]
    return legs, pixels_of(stack, view, 0, stack.height)[chosen]


def claim(stack: ViewStack, legs, own: Tensor, later: int, tolerance: float, claimed: Tensor) -> None:
    """Set to 1, in `claimed` (P), the pixels of height map `later` that show the bed of paths at their own heights."""
    u, v, inside = project_at(stack, legs, own, ..., later)
    corner = _corner(stack, u, v, inside)[0][inside]
    own, heights = own[inside], pixels_of(stack, later, 0, stack.height)
    for offset in (0, 1, stack.width, stack.width + 1):
        same = (heights[corner + offset] - own).abs() < tolerance
        claimed[corner[same] + offset] = 1
