"""Optional terms beside the squared error of the colours; each is off unless it has a weight."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from fields.volume.density_loss import (
    density_loss,
    density_per_half,
    draw_nodes,
    empty_loss,
    gaussian_density_loss,
    printed_density_loss,
)
from fields.volume.paths import Paths
from fields.volume.prior_losses import (
    as_patches,
    ncc_loss,
    normal_prior_loss,
    relative_depth_loss,
    ssim_loss,
    virtual_patch_loss,
)
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.weights import Losses
from refract import WaterSurface


def added_loss(
    losses: Losses, renderer: VolumeRenderer, paths: Paths, rendered: Rendered, cells: Cells, water: WaterSurface | None
) -> Tensor:
    """The weighted sum of the terms, a scalar."""
    model, size, cell = renderer.model, losses.patch, cells.edge
    terms: list[tuple[float, Callable[[], Tensor]]] = [
        (losses.transparency, lambda: transparency_loss(rendered)),
        (losses.distortion, lambda: distortion_loss(paths, rendered)),
        (losses.density, lambda: density_loss(*draw_nodes(model, cell))),
        (losses.gaussian_density, lambda: gaussian_density_loss(model, cell)),
        (losses.printed_density, lambda: printed_density_loss(model, cell)),
        (losses.printed_gaussian_density, lambda: gaussian_density_loss(model, cell, of=density_per_half)),
        (losses.empty, lambda: empty_loss(model, cell)),
        (losses.ncc, lambda: ncc_loss(as_patches(rendered.rgb, size), as_patches(paths.rgb, size))),
        (losses.ssim, lambda: ssim_loss(as_patches(rendered.rgb, size), as_patches(paths.rgb, size))),
        (losses.virtual_patches, lambda: virtual_patch_loss(renderer, paths, rendered, cells, water, size)),
        (losses.depth, lambda: relative_depth_loss(paths, rendered, model.box.edge)),
        (losses.normal, lambda: normal_prior_loss(paths, normals_of(renderer, paths, rendered, 0.5 * cell))),
    ]
    return sum((weight * loss() for weight, loss in terms if weight), rendered.rgb.new_zeros(()))


def normals_of(renderer: VolumeRenderer, paths: Paths, rendered: Rendered, step: float) -> Tensor:
    """Normals (N, 3) at the median of the weights of paths, by differences over ``step`` [m]."""
    return renderer.model.normals(paths.at(rendered.depth.detach()[:, None])[:, 0], step)


def transparency_loss(rendered: Rendered) -> Tensor:
    """Mean transmittance of the paths: for scenes in which every path ends on the bed.

    Without a background it is always zero: the last sample then takes all that reaches it.
    """
    return (1.0 - rendered.opacity).mean()


def distortion_loss(paths: Paths, rendered: Rendered) -> Tensor:
    """Spread of the weights along a path, mean over paths (mip-NeRF 360, Barron et al. 2022, equation 15).

        sum_ij w_i w_j |m_i - m_j| + sum_i w_i^2 d_i / 3

    ``m_i`` is the middle and ``d_i`` the length of interval i, in shares of the path from near to far. Middles rise, so
    that the double sum is twice ``sum_i w_i (m_i sum_{j<i} w_j - sum_{j<i} w_j m_j)``.
    """
    w, edges = rendered.weights, rendered.samples.edges
    span = (paths.far - paths.near).clamp(min=1e-9)[:, None]
    edges = (edges - paths.near[:, None]) / span
    middle, length = 0.5 * (edges[:, 1:] + edges[:, :-1]), edges[:, 1:] - edges[:, :-1]
    before = torch.cumsum(w, dim=1) - w
    moment = torch.cumsum(w * middle, dim=1) - w * middle
    return (2.0 * w * (middle * before - moment) + w**2 * length / 3.0).sum(dim=1).mean()
