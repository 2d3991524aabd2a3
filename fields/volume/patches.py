"""Losses on patches of neighbouring pixels: correlation, structural similarity, and normals that change smoothly.

MonoPatchNeRF (Wu et al. 2024) trains on patches with these. Patches (P, size, size, 3) hold colours as stored, 0 to 1.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Below a spread of one grey value of 255 a patch has no structure to correlate.
NOISE = (1.0 / 255.0) ** 2
# C1 and C2 of SSIM for colours from 0 to 1 (Wang et al. 2004).
C1, C2 = 0.01**2, 0.03**2
WINDOW = 3


def as_patches(values: Tensor, size: int) -> Tensor:
    """Values (N, ...) of paths drawn as patches, as (P, size, size, ...).

    Raises
    ------
    ValueError
        If the paths are no whole number of patches.
    """
    if size < 2 or len(values) % size**2:
        raise ValueError(
            f"expected paths in whole patches of {size} x {size} px, 2 px or more, got {len(values)} paths"
        )
    return values.view(-1, size, size, *values.shape[1:])


def ncc_loss(rendered: Tensor, seen: Tensor) -> Tensor:
    """``1 - (cov + e) / sqrt((var + e) (var' + e))``, mean over patches and channels; blind to brightness and contrast.

    ``e`` is the variance of one grey value: patches without texture count as alike, not as noise.
    """
    x, y = (v.flatten(1, 2) for v in (rendered, seen))
    x, y = x - x.mean(dim=1, keepdim=True), y - y.mean(dim=1, keepdim=True)
    cov = (x * y).mean(dim=1)
    spread = ((x**2).mean(dim=1) + NOISE) * ((y**2).mean(dim=1) + NOISE)
    return (1.0 - (cov + NOISE) / spread.sqrt()).mean()


def ssim_loss(rendered: Tensor, seen: Tensor) -> Tensor:
    """``(1 - SSIM) / 2``, mean over channels and all windows of 3 x 3 px with even weights inside the patches."""
    x, y = (v.permute(0, 3, 1, 2) for v in (rendered, seen))

    def mean(values: Tensor) -> Tensor:
        return nn.functional.avg_pool2d(values, WINDOW, stride=1)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx**2, mean(y * y) - my**2, mean(x * y) - mx * my
    ssim = (2.0 * mx * my + C1) * (2.0 * cov + C2) / ((mx**2 + my**2 + C1) * (vx + vy + C2))
    return 0.5 * (1.0 - ssim).mean()


def smooth_normals_loss(normals: Tensor, seen: Tensor) -> Tensor:
    """Mean squared difference of normals (P, size, size, 3) of neighbours, less across edges of the photograph.

    A pair counts ``exp(-10 |difference of grey|)``: bends of a surface tend to show as edges.
    """
    grey = seen.mean(dim=-1)
    total = torch.zeros(())
    for axis in (1, 2):
        bend = (normals.diff(dim=axis) ** 2).sum(dim=-1)
        total = total + (bend * torch.exp(-10.0 * grey.diff(dim=axis).abs())).mean()
    return total
