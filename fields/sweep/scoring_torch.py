"""How well neighbours agree with a reference, and the best height, in torch: the twin of `fields.sweep.scoring_drjit`.

The same functions with the same signatures, shapes and order of summation, in portions that stay in the cache.
"""

from __future__ import annotations

import torch
from torch import Tensor

from fields.device import Device

# As in `fields.sweep.scoring_drjit`; held equal by a test.
NOISE_VARIANCE = 1.0
# Samples that one operation takes on: 1 MB an array.
PORTION = 250_000


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


def windows(device: Device, reference: Tensor, values: list[Tensor], width: int, radius: int) -> tuple:
    """What `ncc` takes: here no window is laid out before it is needed."""
    return reference, values, width


def ncc(windows: tuple, radius: int, least_known: float = 1.0) -> list[Tensor]:
    """NCC of W (K tensors of J * P) with the reference strip (P) over square windows; see the twin.

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
    """Mean over the better half of the K neighbours that have the window in their image; see the twin."""
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
    wanted = torch.maximum(torch.ceil(0.5 * seen), seen.clamp(max=2.0))
    slots = torch.arange(keep, device=score.device)[:, None]
    total = torch.where(slots < wanted, top, 0.0).sum(dim=0)
    return torch.where(wanted > 0.0, total / wanted.clamp(min=1.0), -1.0)


def best_height(device: Device, mean: Tensor, start: Tensor, step: float, count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Best height [m], its score and its sharpness [1/m^2]; see the twin."""
    lost = len(start) * count - len(mean)
    start = start[lost // 2 : len(start) - lost // 2]
    # From rung to rung the same place is one strip farther.
    ladder = mean.as_strided((count, len(start)), (len(start) + lost, 1))
    at = ladder.argmax(dim=0, keepdim=True)  # the first of equals
    best, low, high = (ladder.gather(0, i)[0] for i in (at, (at - 1).clamp(min=0), (at + 1).clamp(max=count - 1)))
    inner = ((at > 0) & (at < count - 1))[0]
    bend = 2.0 * best - low - high
    offset = (0.5 * (high - low) / bend.clamp(min=1e-6)).clamp(-0.5, 0.5)
    offset = torch.where(inner & (bend > 1e-6), offset, 0.0)
    height = start + (at[0] + offset) * float(step)
    curvature = torch.where(inner, bend.clamp(min=0.0) / float(step) ** 2, 0.0)
    return height, best, curvature
