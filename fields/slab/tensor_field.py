"""The multi-scale tensor field: features, heads and water, rendered along bent rays inside the slab."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fields.compositing import (
    MIN_COLOUR_WEIGHT,
    composite,
    log_transmittance,
    quantile_height,
    render_weights,
    with_opaque_end,
)
from fields.device import Device
from fields.factors import Factors, anisotropic_grids
from fields.heads import ColourHead, DensityHead
from fields.image_store import as_stored
from fields.slab.rays import Slab, SlabRays
from fields.water_column import WaterColumn


@dataclass(frozen=True)
class FieldSettings:
    """Grid and heads of a field."""

    # scales, channels: L and n_f of the paper
    scales: int = 4
    channels: int = 4
    coarsening: float = 8.0  # Cells of the coarsest scale over those of the finest, which measure one GSD
    # Per ray, inside the slab: the paper's sampling within +-s of the proxy surface. Fewer than 100, so that one at
    # least is heavy enough for a colour; others raise ValueError.
    samples: int = 8

    def __post_init__(self):
        if not 2 <= self.samples < 1.0 / MIN_COLOUR_WEIGHT:
            raise ValueError(f"a field has {self.samples} samples per ray, expected 2 to 99")


class TensorField(nn.Module):
    """Density and colour inside a slab about the bed's proxy.

    Vectors run along zeta, planes lie in x and y: in the thin slab other directions add nothing. The raw density
    moves the bed: signed distance = zeta - half * tanh(raw), with a Laplace law of learned width, so that the middle of
    a ray's weights is the bed and a field of zero the proxy. The bed is matt. (A box of any content, with three
    directions and colours that depend on the view: `fields.volume`.) ``column`` is the water over the bed, None for a
    dry survey.
    """

    def __init__(self, slab: Slab, settings: FieldSettings, device: Device, column: WaterColumn | None):
        super().__init__()
        self.slab, self.settings = slab, settings
        cell = np.array([slab.cell, slab.cell, slab.half / 4.0])
        grids = anisotropic_grids(slab.size, cell, settings.coarsening, settings.scales)
        shape = (settings.scales, 1, settings.channels)
        self.factors = Factors(grids, "z", settings.channels, device)
        self.density = DensityHead(*shape, device=device)
        self.colour = ColourHead(*shape)
        self.column = column
        # Half a cell: tails that reach a face of the slab pull the bed away from it.
        self.log_width = nn.Parameter(torch.log(torch.tensor(0.5 * slab.cell, dtype=torch.float32)))

    def _features(self, position: Tensor, zeta: Tensor) -> Tensor:
        """Features (samples, ...) at positions (..., 3) [m], zeta (...) [m] over the proxy."""
        return self.factors(self.slab.box_coordinates(position[..., :2], zeta).view(-1, 3))

    def _thickness(self, features: Tensor, zeta: Tensor) -> Tensor:
        """Density times length (rays, samples) of the intervals, from the features (samples,) at their middles.

        ``zeta`` (rays, samples + 1) [m] are the heights of their ends over the proxy.
        """
        raw = self.density(features).view(len(zeta), -1)
        lift, width = self.slab.half * torch.tanh(raw), self.log_width.exp()
        start = log_transmittance(zeta[:, :-1] - lift, width)
        end = log_transmittance(zeta[:, 1:] - lift, width)
        # What the tail of the law takes above the slab counts to the first sample, so that the middle stays the bed.
        start = torch.cat([torch.zeros_like(start[:, :1]), start[:, 1:]], dim=1)
        return (start - end).clamp(min=0.0)

    def intervals(self, rays: SlabRays, jitter: bool) -> Tensor:
        """Heights (rays, samples + 1) [m] of the intervals' ends, downwards through the slab about each ray's proxy."""
        n = self.settings.samples
        step = 2.0 * self.slab.half / n
        ends = self.slab.half - step * torch.arange(n + 1, dtype=torch.float32)
        shift = (torch.rand(len(rays), 1) - 0.5) * step if jitter else torch.zeros(len(rays), 1)
        return rays.height[:, None] + ends + shift

    def weigh(self, rays: SlabRays, *, jitter: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Weights (rays, samples), interval ends (rays, samples + 1) [m] and features (rays * samples, ...)."""
        ends = self.intervals(rays, jitter)
        z = _middles(ends)
        zeta = ends - self.slab.height_at(rays.at(ends)[..., :2].reshape(-1, 2)).view_as(ends)
        features = self._features(rays.at(z), _middles(zeta))
        weights = render_weights(self._thickness(features, zeta))
        # The bed is opaque: light that passed the slab's lower end met it there.
        return with_opaque_end(weights), ends, features

    def render(self, rays: SlabRays, *, jitter: bool, dry: bool = False) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (rays, 3) as stored in photographs, weights (rays, samples) and interval ends (rays, samples + 1).

        ``dry`` leaves out what the water does to the light.
        """
        weights, ends, features = self.weigh(rays, jitter=jitter)
        z = _middles(ends)
        radiance = composite(weights, lambda where: self.colour(features[where], None))
        if self.column is not None and not dry:
            bed = (weights.detach() * z).sum(dim=1)
            depth = (-bed).clamp(min=0.0)
            way = self.column.way(depth, depth * rays.wet.norm(dim=1))
            # Light of dry ground crosses no surface.
            radiance = self.column(radiance, way, torch.where(bed < 0.0, rays.reflectance, 0.0))
        return as_stored(radiance), weights, ends

    @torch.no_grad()
    def heights(self, rays: SlabRays) -> tuple[Tensor, Tensor]:
        """Median height [m] of each ray's weights, and half the distance between their 16 and 84 % heights [m]."""
        weights, ends, _ = self.weigh(rays, jitter=False)
        low, high = quantile_height(weights, ends, 0.84), quantile_height(weights, ends, 0.16)
        return quantile_height(weights, ends), 0.5 * (high - low).abs()

    @torch.no_grad()
    def look(self, rays: SlabRays, up: Tensor, *, dry: bool) -> tuple[Tensor, Tensor, Tensor]:
        """Colours (rays, 3) as stored in photographs, median heights (rays,) [m] and upward unit normals (rays, 3).

        ``up`` (3,) is the normal of the water plane, along which heights count.
        """
        colour, weights, ends = self.render(rays, jitter=False, dry=dry)
        height = quantile_height(weights, ends)
        return colour, height, self._normals(rays.at(height), height, up)

    def _normals(self, position: Tensor, z: Tensor, up: Tensor) -> Tensor:
        """Unit normals (N, 3) of the bed, local, at positions (N, 3) [m] on it, z (N,) [m] over the water plane.

        The gradient of the signed distance, by central differences of half a cell to each side, over which the
        features are linear.
        """
        step = 0.5 * self.slab.cell
        along_x, along_y = (step * torch.eye(3)[axis] for axis in (0, 1))
        gradient = (self._above(position, z + step) - self._above(position, z - step))[:, None] * up
        gradient[:, 0] += self._above(position + along_x, z) - self._above(position - along_x, z)
        gradient[:, 1] += self._above(position + along_y, z) - self._above(position - along_y, z)
        return nn.functional.normalize(gradient, dim=1)

    def _above(self, position: Tensor, z: Tensor) -> Tensor:
        """Signed distance (N,) [m], positive above the bed."""
        zeta = z - self.slab.height_at(position[:, :2])
        raw = self.density(self._features(position, zeta))
        return zeta - self.slab.half * torch.tanh(raw)


def _middles(ends: Tensor) -> Tensor:
    return 0.5 * (ends[:, 1:] + ends[:, :-1])
