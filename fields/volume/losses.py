"""Optional terms beside the squared error of the colours; each is off unless it has a weight.

The density loss is for large scenes:

    a        = 1 - exp(-density l), the opacity of a piece of length l                                            (1)
    L_dens   = mean (exp |l da/dx| - 1) + mean (exp var a - 1)                                                    (2)
    L_gauss  = mean (a - a_s)^2, a_s the mean of a over Gaussian neighbours                                       (3)
    L_dens   = mean exp |ds/dp| + mean exp var s,   L_gauss = mean (s - s_s)^2                                    (4)
    L_empty  = mean a                                                                                             (5)

As printed the losses are (4), of the density s itself, here per half of the box's longest edge, which is 1 in p as in
the authors' scenes. It has no bound, and where an exponent exceeds `LIMIT` exp goes on along its tangent, since a wall
overflows it. The printed l1(exp(grad s)) has no magnitude inside; without one it would depend on the way that axes
point. In (2) and (3), which are used here, opacity over one length takes the place of density: its differences over l
and its variance stay within 1, and the one taken off in (2) lets even density cost nothing. Means and variances run
over the points drawn uniformly in each node of a coarse grid. (5) is the transparency of Inf-NeRF's code, of opacity
over a cell in place of the unit of its scenes.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from fields.volume.model import VolumeModel
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

# Nodes along the longest edge; nodes drawn a step, and points in each.
NODES, DRAWN, POINTS = 16, 128, 8
# Pairs of Gaussian neighbours of a point.
PAIRS = 4
# Above this exponent, exp is replaced by its tangent.
LIMIT = 5.0


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


def opacity(model: VolumeModel, x: Tensor, length: float) -> Tensor:
    """Share (...) of light that a piece of ``length`` [m] stops, at positions (..., 3) [m]."""
    density = model.evaluate(x.reshape(-1, 3))[0].view(x.shape[:-1])
    return -torch.expm1(-density * length)


def density_per_half(model: VolumeModel, x: Tensor, length: float) -> Tensor:
    """Density (...) [1 / half of the longest edge] at positions (..., 3) [m], whatever the length."""
    return 0.5 * model.box.edge * model.evaluate(x.reshape(-1, 3))[0].view(x.shape[:-1])


def draw_nodes(
    model: VolumeModel,
    length: float,
    *,
    drawn: int = DRAWN,
    points: int = POINTS,
    of: Callable[[VolumeModel, Tensor, float], Tensor] = opacity,
) -> tuple[Tensor, Tensor]:
    """Opacities (M, P), or ``of``, and gradients (M, P, 3) at points drawn uniformly in nodes, themselves drawn.

    ``length`` is l [m]; the gradients are ``l grad a``, by central differences over l, each component within 1.
    """
    counts = model.box.counts(NODES)
    place = model.place
    node = torch.randint(0, int(np.prod(counts)), (drawn,), device=place)
    corner = torch.stack(torch.unravel_index(node, counts), dim=-1)
    low, size = (_single(v, place) for v in (model.box.low, model.box.size / counts))
    x = low + size * (corner[:, None] + torch.rand(drawn, points, 3, device=place))
    axes = torch.eye(3, device=place)
    offsets = 0.5 * length * torch.cat([axes.new_zeros(1, 3), axes, -axes])
    middle, after, before = of(model, x[:, :, None] + offsets, length).split([1, 3, 3], dim=2)
    return middle[:, :, 0], after - before


def density_loss(opacities: Tensor, gradient: Tensor) -> Tensor:
    """Equation (2): l1 of the exponentials of gradient and variance, of what `draw_nodes` gives."""
    return torch.expm1(gradient.abs()).mean() + torch.expm1(opacities.var(dim=1, correction=0)).mean()


def printed_density_loss(model: VolumeModel, length: float, *, drawn: int = DRAWN, points: int = POINTS) -> Tensor:
    """Equation (4), with central differences over ``length`` [m]."""
    density, gradient = draw_nodes(model, length, drawn=drawn, points=points, of=density_per_half)
    gradient = gradient.abs() * (0.5 * model.box.edge / length)
    return limited_exp(gradient).mean() + limited_exp(density.var(dim=1, correction=0)).mean()


def limited_exp(x: Tensor) -> Tensor:
    """exp up to `LIMIT`, and its tangent there beyond it."""
    return torch.exp(x.clamp(max=LIMIT)) * (1.0 + (x - LIMIT).clamp(min=0.0))


def empty_loss(model: VolumeModel, length: float, *, points: int = DRAWN * POINTS) -> Tensor:
    """Equation (5) at points drawn uniformly in the box, of pieces of ``length`` [m]."""
    low, size = (_single(v, model.place) for v in (model.box.low, model.box.size))
    return opacity(model, low + size * torch.rand(points, 3, device=model.place), length).mean()


def gaussian_density_loss(
    model: VolumeModel,
    length: float,
    *,
    points: int = DRAWN * POINTS,
    of: Callable[[VolumeModel, Tensor, float], Tensor] = opacity,
) -> Tensor:
    """Equation (3) at points drawn uniformly in the box; neighbours at a standard deviation of ``length`` [m].

    With `density_per_half` it is that of (4).

    Neighbours come in pairs about the point, so that density that changes linearly costs nothing.
    """
    place = model.place
    low, size = (_single(v, place) for v in (model.box.low, model.box.size))
    x = low + size * torch.rand(points, 1, 3, device=place)
    offsets = length * torch.randn(points, PAIRS, 3, device=place)
    a = of(model, torch.cat([x, x + offsets, x - offsets], dim=1), length)
    return ((a[:, 0] - a[:, 1:].mean(dim=1)) ** 2).mean()


def _single(values: np.ndarray, place: torch.device) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float32, device=place)
