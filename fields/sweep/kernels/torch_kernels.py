"""The kernels of the sweep in torch: those of `drjit_kernels` where Dr.Jit does not run.

The same functions with the same signatures and shapes (K neighbours, J hypotheses, P pixels of a strip, flat). Torch
computes step by step, so samples are taken in portions that stay in the processor's cache.
"""

import torch
from torch import Tensor

from fields.device import Device
from fields.sweep.kernels import rays as geometry
from fields.sweep.kernels.arrays import floats, indices
from fields.sweep.kernels.stack import MASKED, NOISE_VARIANCE, Hypotheses, ViewStack

PORTION = 250_000  # Samples that one operation takes on: 1 MB an array


def sample_packed(stack: ViewStack, view: int, u: Tensor, v: Tensor, inside: Tensor) -> Tensor:
    """Bilinear samples of `ViewStack.packed`: one lookup instead of the four of `sample`."""
    packed = stack.packed
    corner, fx, fy = geometry.corner_of(stack, view, u, v, inside)
    word = packed.values(view)[corner]
    parts = [(word >> (place * packed.bits)) & (2**packed.bits - 1) for place in range(4)]
    value = geometry.bilinear([part.float() for part in parts], fx, fy) * packed.step + packed.low
    return torch.where(inside & (parts[0] != MASKED), value, torch.nan)


def warp(values: list[Tensor], stack: ViewStack, rays, hypotheses: Hypotheses, neighbours: list[int]) -> None:
    """Fill ``values`` (`buffers`) with W of each neighbour; NaN outside its image."""
    start, step, count = hypotheses.start, hypotheses.step, hypotheses.count
    begin = floats(stack.device, start)
    arrays = [each.view(count, len(begin)) for each in values]
    numbers = torch.arange(count, dtype=torch.float32, device=begin.device)[:, None]
    for part in geometry.segments(count):
        span = step * max(len(part) - 1, 1)
        three = [geometry.point_at(rays, begin + step * part.start + share * span) for share in (0.0, 0.5, 1.0)]
        curves = []
        for row in (stack.camera_rows[view] for view in neighbours):
            places = [geometry.project_in_front(row, p, stack.kernel_water, stack.terms) for p in three]
            curves.append(geometry.fit_curve(places))
        per_call = max(1, PORTION // len(begin))
        for first in range(part.start, part.stop, per_call):
            rows = slice(first, min(first + per_call, part.stop))
            at = (numbers[rows] - part.start) * (step / span)
            for target, curve, view in zip(arrays, curves, neighbours, strict=True):
                target[rows] = sample_packed(stack, view, *geometry.point_on_curve(curve, at, stack.camera_rows[view]))
        straddling = indices(stack.device, geometry.straddling_pixels(stack, start, step, part))
        if len(straddling):
            some = [leg[straddling] for leg in rays]
            points = geometry.point_at(some, begin[straddling] + step * numbers[part.start : part.stop])
            for target, view in zip(arrays, neighbours, strict=True):
                seen = geometry.project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
                target[part.start : part.stop, straddling] = sample_packed(stack, view, *seen)


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


def buffers(device: Device, count: int, size: int) -> list[Tensor]:
    """Tensors of J * P for so many neighbours."""
    return [torch.empty(size, device=device.place) for _ in range(count)]


def reference_buffer(device: Device, size: int) -> None:
    """No memory: the reference is read where it is."""


def prepare_windows(
    device: Device, reference: Tensor, greys: None, values: list[Tensor], width: int, radius: int
) -> tuple:
    """Windows for `ncc`: here none is laid out before it is needed."""
    return reference, values, width


def ncc(windows: tuple, radius: int, least_known: float = 1.0) -> list[Tensor]:
    """NCC of W (K tensors of J * P) with the reference strip (P) over square windows; as in Dr.Jit.

    Windows that leave the strip, or its first and last columns, are incomplete.
    """
    reference, values, width = windows
    grey, lost = reference.reshape(-1, width), radius * (width + 1)
    m_i = _window_means(grey, radius)
    v_i = (_window_means(grey * grey, radius) - m_i * m_i).clamp(min=NOISE_VARIANCE)
    per_call = max(1, PORTION // grey.numel())
    scores = []
    for images in (each.reshape(-1, *grey.shape) for each in values):
        score = torch.full_like(images, -1.0)
        inner = score[:, radius : grey.shape[0] - radius, radius : width - radius]
        for part, target in zip(images.split(per_call), inner.split(per_call), strict=True):
            if least_known < 1.0:
                target.copy_(_ncc_of_known(part, grey, radius, least_known))
                continue
            mean = _window_means(part, radius)
            variance = (_window_means(part * part, radius) - mean * mean).clamp(min=NOISE_VARIANCE)
            found = (_window_means(part * grey, radius) - mean * m_i) * torch.rsqrt(variance * v_i)
            # An incomplete window is NaN; a complete one stays above -1, the mark of an incomplete one.
            target.copy_(torch.where(found.isnan(), -1.0, found.clamp(min=-0.999)))
        scores.append(score.reshape(-1)[lost : score.numel() - lost])
    return scores


def _ncc_of_known(images: Tensor, grey: Tensor, radius: int, least: float) -> Tensor:
    """NCC of windows over the pixels that both have; -1 where these are a smaller share than ``least``."""
    known = ~(images.isnan() | grey.isnan())
    w, i = (torch.where(known, each, 0.0) for each in (images, grey))
    share = _window_means(known.float(), radius)
    parts = (_window_means(each, radius) / share.clamp(min=1e-6) for each in (w, i, w * w, i * i, w * i))
    m_w, m_i, v_w, v_i, product = parts
    v_w, v_i = ((v - m * m).clamp(min=NOISE_VARIANCE) for v, m in ((v_w, m_w), (v_i, m_i)))
    score = ((product - m_w * m_i) * torch.rsqrt(v_w * v_i)).clamp(min=-0.999)
    # A part of a pixel, for what the mean is rounded by.
    return torch.where(share < least - 1e-4, -1.0, score)


def best_half(device: Device, scores: list[Tensor]) -> Tensor:
    """Mean over the better half of the K neighbours that have the window in their image; as in Dr.Jit."""
    keep = max((len(scores) + 1) // 2, min(2, len(scores)))
    parts = zip(*(score.split(PORTION) for score in scores), strict=True)
    return torch.cat([_best_half(torch.stack(part), keep) for part in parts])


def _best_half(score: Tensor, keep: int) -> Tensor:
    """`best_half` of scores (neighbours, places), of which at most `keep` count."""
    top = torch.full_like(score[:keep], -1.0)
    seen = (score > -1.0).sum(dim=0).float()
    for s in score:
        for slot in range(keep):  # insertion into a short sorted list, largest first
            high = torch.maximum(top[slot], s)
            s = torch.minimum(top[slot], s)
            top[slot] = high
    num_averaged = torch.maximum(torch.ceil(0.5 * seen), seen.clamp(max=2.0))
    slots = torch.arange(keep, device=score.device)[:, None]
    total = torch.where(slots < num_averaged, top, 0.0).sum(dim=0)
    return torch.where(num_averaged > 0.0, total / num_averaged.clamp(min=1.0), -1.0)


def best_height(device: Device, mean: Tensor, start: Tensor, step: float, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Best height [m], its score and curvature [1/m^2]; as in Dr.Jit."""
    lost = len(start) * count - len(mean)
    start = start[lost // 2 : len(start) - lost // 2]
    # From hypothesis to hypothesis the same place is one strip farther.
    scores = mean.as_strided((count, len(start)), (len(start) + lost, 1))
    at = scores.argmax(dim=0, keepdim=True)  # the first of equals
    best, low, high = (scores.gather(0, i)[0] for i in (at, (at - 1).clamp(min=0), (at + 1).clamp(max=count - 1)))
    inner = ((at > 0) & (at < count - 1))[0]
    bend = 2.0 * best - low - high
    offset = (0.5 * (high - low) / bend.clamp(min=1e-6)).clamp(-0.5, 0.5)
    offset = torch.where(inner & (bend > 1e-6), offset, 0.0)
    height = start + (at[0] + offset) * float(step)
    curvature = torch.where(inner, bend.clamp(min=0.0) / float(step) ** 2, 0.0)
    return height, best, curvature
