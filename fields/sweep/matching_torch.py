"""Photo-consistency along bent rays in torch: the twin of `fields.sweep.matching` where Dr.Jit does not run.

The same functions with the same signatures, shapes (K neighbours, J rungs, P pixels of a strip, flat) and order of
summation. Torch computes step by step, so samples are taken in portions that stay in the processor's cache.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fields.device import Device
from fields.sweep.stack import CAMERA_ROW, ViewStack, camera_table
from refract import kernels

# As in `fields.sweep.matching`; held equal by a test.
CROSSING_STEPS = 1
NOISE_VARIANCE = 1.0
# Samples (neighbours x rungs x pixels) of one strip: 32 MB an array.
STRIP_SAMPLES = 8_000_000
# Samples that one operation takes on: 1 MB an array.
PORTION = 250_000


def floats(device: Device, array: np.ndarray) -> Tensor:
    """An array of any shape as one flat float32 tensor, copied."""
    return torch.tensor(np.asarray(array, dtype=np.float32), device=device.place).reshape(-1)


def indices(device: Device, array) -> Tensor:
    """Whole numbers from zero as one flat int64 tensor, copied."""
    return torch.tensor(np.asarray(array, dtype=np.int64), device=device.place).reshape(-1)


def host(array: Tensor) -> np.ndarray:
    """A tensor as numpy, flat."""
    return array.reshape(-1).cpu().numpy()


def release() -> None:
    """Give memory that is no longer used back to the system."""
    if torch.cuda.is_available():
        torch.cuda.empty_cache()


def pixels_of(stack: ViewStack, view: int, first_row: int, rows: int) -> Tensor:
    """A strip of rows of the image of `view`: P = rows * width values."""
    first = (view * stack.height + first_row) * stack.width
    return stack.pixels[first : first + rows * stack.width]


def legs_of(stack: ViewStack, view: int, first_row: int, rows: int) -> list[Tensor]:
    """Foot on the water plane (3), air slope (3) and water slope (3) of each pixel; see `matching.legs_of`."""
    like = {"dtype": torch.float32, "device": stack.device.place}
    v, u = torch.meshgrid(
        torch.arange(rows, **like) + (first_row + 0.5), torch.arange(stack.width, **like) + 0.5, indexing="ij"
    )
    cam = [float(c) for c in camera_table([stack.cameras[view]])[0]]
    x, y = (u.reshape(-1) - cam[14]) / cam[12], (v.reshape(-1) - cam[15]) / cam[13]
    ray = [cam[c] * x + cam[3 + c] * y + cam[6 + c] for c in range(3)]
    length = torch.rsqrt(kernels.dot(ray, ray))
    ray = tuple(c * length for c in ray)
    plane, normal, n_water = stack.plane
    fall = kernels.dot(ray, normal)
    fall = torch.where(fall < -1e-3, fall, torch.nan)
    height = kernels.dot(tuple(c - p for c, p in zip(cam[9:12], plane, strict=True)), normal)
    foot = kernels.along(cam[9:12], ray, -height / fall)
    bent = kernels.bend(ray, normal, 1.0, n_water)
    fall_wet = kernels.dot(bent, normal)
    return [*foot, *(c / fall for c in ray), *(c / fall_wet for c in bent)]


def project_at(stack: ViewStack, legs, z: Tensor, pixel, view):
    """Pixel position in `view`, and whether inside it, of the path of `pixel` at height `z`.

    `pixel` indexes the legs: a tensor, or ``...`` for all of them against the last axis of `z`. `view` is a number or
    a tensor of them.
    """
    leg = [row[pixel] for row in legs]
    above = z > 0.0
    point = tuple(leg[c] + z * torch.where(above, leg[3 + c], leg[6 + c]) for c in range(3))
    cam = stack.table.reshape(-1, CAMERA_ROW)[view].unbind(-1)
    centre = cam[9:12]
    if stack.water is not None:
        point, _ = kernels.crossing_of_point(centre, point, *stack.plane, CROSSING_STEPS)
    d = tuple(p - c for p, c in zip(point, centre, strict=True))
    x, y, depth = kernels.dot(cam[0:3], d), kernels.dot(cam[3:6], d), kernels.dot(cam[6:9], d)
    u = cam[12] * x / depth + cam[14]
    v = cam[13] * y / depth + cam[15]
    inside = (u >= 0.5) & (v >= 0.5) & (u < cam[16] - 0.5) & (v < cam[17] - 0.5) & (depth > 0.0)
    return u, v, inside


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


def _window_means(images: Tensor, radius: int) -> Tensor:
    """Means over whole windows of 2 radius + 1 pixels squared: (..., rows - 2 radius, width - 2 radius)."""
    for axis in (-1, -2):
        size = max(images.shape[axis] - 2 * radius, 0)
        parts = [images.narrow(axis, offset, size) for offset in range(min(2 * radius + 1, images.shape[axis]))]
        total = parts[0].clone()
        for part in parts[1:]:
            total += part
        images = total
    return images * (1.0 / (2 * radius + 1) ** 2)


def ncc(device: Device, reference: Tensor, values: Tensor, width: int, radius: int) -> Tensor:
    """NCC of W (K * J * P) with the reference strip (P) over square windows; -1 where a window is incomplete.

    Windows that leave the strip, or its first and last columns, are incomplete.
    """
    grey = reference.reshape(-1, width)
    m_i = _window_means(grey, radius)
    v_i = (_window_means(grey * grey, radius) - m_i * m_i).clamp(min=NOISE_VARIANCE)
    images = values.reshape(-1, *grey.shape)
    score = torch.full_like(images, -1.0)
    inner = score[:, radius : grey.shape[0] - radius, radius : width - radius]
    per_call = max(1, PORTION // grey.numel())
    for part, target in zip(images.split(per_call), inner.split(per_call), strict=True):
        mean = _window_means(part, radius)
        variance = (_window_means(part * part, radius) - mean * mean).clamp(min=NOISE_VARIANCE)
        found = (_window_means(part * grey, radius) - mean * m_i) * torch.rsqrt(variance * v_i)
        # An incomplete window is NaN; a complete one stays above -1, the mark of an incomplete one.
        target.copy_(torch.where(found.isnan(), -1.0, found.clamp(min=-0.999)))
    return score.reshape(-1)


def best_half(device: Device, score: Tensor, neighbours: int) -> Tensor:
    """Mean over the better half of the neighbours that have the window, (J * P); see `matching.best_half`."""
    keep = max((neighbours + 1) // 2, min(2, neighbours))
    parts = score.reshape(neighbours, -1).split(PORTION, dim=1)
    return torch.cat([_best_half(part, keep) for part in parts])


def _best_half(score: Tensor, keep: int) -> Tensor:
    """`best_half` of scores (neighbours, places), of which at most `keep` count."""
    top = torch.full_like(score[:keep], -1.0)
    seen = (score > -1.0).sum(dim=0).float()
    for s in score:
        for slot in range(keep):  # insertion into a short sorted list, largest first
            high = torch.maximum(top[slot], s)
            s = torch.minimum(top[slot], s)
            top[slot] = high
    wanted = torch.maximum(torch.ceil(0.5 * seen), seen.clamp(max=2.0))
    slots = torch.arange(keep, device=score.device)[:, None]
    total = torch.where(slots < wanted, top, 0.0).sum(dim=0)
    return torch.where(wanted > 0.0, total / wanted.clamp(min=1.0), -1.0)


def climb(device: Device, mean: Tensor, start: Tensor, step: float, rungs: int) -> tuple[Tensor, Tensor, Tensor]:
    """Best height (P) [m], its score (P) and its sharpness (P) [1/m^2]; see `fields.sweep.matching.climb`."""
    ladder = mean.reshape(rungs, -1)
    at = ladder.argmax(dim=0, keepdim=True)  # the first of equals
    best, low, high = (ladder.gather(0, i)[0] for i in (at, (at - 1).clamp(min=0), (at + 1).clamp(max=rungs - 1)))
    inner = ((at > 0) & (at < rungs - 1))[0]
    bend = 2.0 * best - low - high
    offset = (0.5 * (high - low) / bend.clamp(min=1e-6)).clamp(-0.5, 0.5)
    offset = torch.where(inner & (bend > 1e-6), offset, 0.0)
    height = start + (at[0] + offset) * float(step)
    curvature = torch.where(inner, bend.clamp(min=0.0) / float(step) ** 2, 0.0)
    return height, best, curvature


def compare(stack: ViewStack, view: int, peers: list[int], tolerance: float) -> tuple[Tensor, Tensor, Tensor]:
    """Count, sum and sum of squares (P) of the differences below `tolerance`; see `fields.sweep.matching.compare`."""
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
