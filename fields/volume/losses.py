"""Optional terms beside the squared error of the colours; each is off unless it has a weight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from fields.models import LossWeights
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
    length_loss,
    ncc_loss,
    normal_prior_loss,
    predicted_normals,
    relative_depth_loss,
    smooth_normals_loss,
    ssim_loss,
    virtual_patch_loss,
    virtual_view_loss,
)
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells
from refract import WaterSurface


@dataclass(frozen=True)
class Losses(LossWeights):
    """The additional losses, with their weights."""

    appearance: float = 0.0  # of the vectors of photographs
    length: float = 0.0  # of lengths with a standard deviation, which the photographs must then carry

    @property
    def patch(self) -> int:
        """Side [px] of the patches that training has to draw; 1 for single pixels."""
        return self._size if self.ncc or self.ssim or self.smooth_normals or self.virtual_patches else 1

    @property
    def _size(self) -> int:
        return self.patch_px or 8

    def __call__(
        self, renderer: VolumeRenderer, paths: Paths, rendered: Rendered, cells: Cells, water: WaterSurface | None
    ) -> Tensor:
        """The weighted sum, a scalar."""
        batch = Batch(renderer, paths, rendered, cells)
        size = self._size
        terms: list[tuple[float, Callable[[], Tensor]]] = [
            (self.transparency, lambda: transparency_loss(rendered)),
            (self.distortion, lambda: distortion_loss(paths, rendered)),
            (self.orientation, lambda: orientation_loss(batch.normals, batch.direction, rendered.opacity.detach())),
            (self.appearance, lambda: appearance_loss(renderer, paths)),
            (self.density, lambda: density_loss(draw_nodes(renderer.model, batch.cell))),
            (self.gaussian_density, lambda: gaussian_density_loss(renderer.model, batch.cell)),
            (self.printed_density, lambda: printed_density_loss(renderer.model, batch.cell)),
            (
                self.printed_gaussian_density,
                lambda: gaussian_density_loss(renderer.model, batch.cell, of=density_per_half),
            ),
            (self.empty, lambda: empty_loss(renderer.model, batch.cell)),
            (self.virtual_views, lambda: virtual_view_loss(renderer, paths, rendered, cells, water)),
            (self.ncc, lambda: ncc_loss(as_patches(rendered.rgb, size), as_patches(paths.rgb, size))),
            (self.ssim, lambda: ssim_loss(as_patches(rendered.rgb, size), as_patches(paths.rgb, size))),
            (
                self.smooth_normals,
                lambda: smooth_normals_loss(as_patches(batch.normals, size), as_patches(paths.rgb, size)),
            ),
            (self.virtual_patches, lambda: virtual_patch_loss(renderer, paths, rendered, cells, water, size)),
            (self.length, lambda: length_loss(paths, rendered)),
            (self.depth, lambda: relative_depth_loss(paths, rendered, renderer.model.box.edge)),
            (self.normal, lambda: normal_prior_loss(paths, batch.normals)),
            (self.predicted_normal, lambda: normal_prior_loss(paths, predicted_normals(rendered))),
        ]
        return sum((weight * loss() for weight, loss in terms if weight), rendered.rgb.new_zeros(()))


@dataclass
class Batch:
    """A batch of rendered paths; depth, directions and normals are computed once for all losses that need them."""

    renderer: VolumeRenderer
    paths: Paths
    rendered: Rendered
    cells: Cells

    @property
    def cell(self) -> float:
        """Edge [m] of a cell of the proxy."""
        return self.cells.box.edge / max(self.cells.occupied.shape)

    @cached_property
    def depth(self) -> Tensor:
        """Path length (N, 1) [m] to the median of the weights, without gradient."""
        return self.rendered.depth.detach()[:, None]

    @cached_property
    def direction(self) -> Tensor:
        """Unit directions of travel (N, 3) there."""
        return self.paths.direction(self.depth)[:, 0]

    @cached_property
    def normals(self) -> Tensor:
        """Normals (N, 3) there, by differences over one cell of the proxy."""
        return self.renderer.model.normals(self.paths.at(self.depth)[:, 0], 0.5 * self.cell)


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


def orientation_loss(normals: Tensor, direction: Tensor, opacity: Tensor) -> Tensor:
    """Mean of ``opacity max(0, n . d)^2``: no visible surface faces away (Ref-NeRF, Verbin et al. 2022, equation 11).

    Evaluated at the median of the weights of each path; the paper evaluates every sample.
    """
    return (opacity * (normals * direction).sum(dim=1).clamp(min=0.0) ** 2).mean()


def appearance_loss(renderer: VolumeRenderer, paths: Paths) -> Tensor:
    """Mean square of the appearance vectors of the paths, so that what photographs share goes into the colour.

    Raises ValueError if the renderer has no appearance vectors.
    """
    if renderer.appearance is None:
        raise ValueError("the loss on appearance has a weight, but the volume has no appearance vectors; give it some")
    return (renderer.appearance(paths.view) ** 2).mean()
