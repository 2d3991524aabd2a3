"""Samples along a path: in the occupied cells of a proxy, or by the weights of another field.

And volume rendering along them: from the thickness of samples to weights, and from weights to height and colour.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor, nn

from fields.volume.paths import Box, Paths

BINS = 128  # Cells of the proxy are looked up this often along a path


@dataclass
class Samples:
    """Samples (N, K) along paths, in the order of travel."""

    s: Tensor  # (N, K) [m]: path lengths at which the field is evaluated
    length: Tensor  # (N, K) [m]: of the piece of path that each sample represents
    edges: Tensor  # (N, K + 1) [m]: path lengths at which the pieces begin and end


def inverse_cdf(bin_edges: Tensor, mass: Tensor, level: Tensor) -> Tensor:
    """Positions (N, K) at which the accumulated mass passes levels (N, K) of its total, linear inside a bin.

    ``bin_edges`` (N, B + 1) rise, ``mass`` (N, B) is not negative and not all zero.
    """
    total = torch.cumsum(mass, dim=1)
    target = (level * total[:, -1:]).contiguous()
    index = torch.searchsorted(total, target, right=True).clamp(max=mass.shape[1] - 1)
    bin_mass = mass.gather(1, index)
    share = ((target - (total.gather(1, index) - bin_mass)) / bin_mass.clamp(min=1e-12)).clamp(0.0, 1.0)
    start, end = bin_edges.gather(1, index), bin_edges.gather(1, index + 1)
    return start + share * (end - start)


def samples_by_mass(bin_edges: Tensor, mass: Tensor, num: int, jitter: bool, *, dense: bool) -> Samples:
    """``num`` samples a path, distributed over the bins by their mass.

    ``bin_edges``, ``mass`` (N, B + 1) [m], (N, B): a path without mass is sampled evenly. ``jitter``: shift all samples
    of a path by the same random share of a step. ``dense``: bins without mass are part of the volume (proposal
    sampling); else they are empty, and a piece counts the length of the bins with mass that it covers.
    """
    mass = torch.where(mass.sum(dim=1, keepdim=True) > 0.0, mass, torch.ones_like(mass))
    levels = torch.arange(num + 1, dtype=mass.dtype, device=mass.device) / num
    shift = torch.rand(len(mass), 1, device=mass.device) if jitter else mass.new_full((len(mass), 1), 0.5)
    edges = inverse_cdf(bin_edges, mass, levels.expand(len(mass), -1).contiguous())
    s = inverse_cdf(bin_edges, mass, (levels[:-1] + shift / num).contiguous())
    if dense:
        return Samples(s, edges[:, 1:] - edges[:, :-1], edges)
    filled = ((bin_edges[:, 1:] - bin_edges[:, :-1]) * (mass > 0.0)).sum(dim=1, keepdim=True)
    return Samples(s, (filled / num).expand_as(s), edges)


@dataclass
class Cells:
    """Cells of a box that may hold a surface: all at first, then those near opaque ones."""

    box: Box
    occupied: Tensor  # (nx, ny, nz) bool

    @staticmethod
    def everywhere(box: Box, num: int) -> Cells:
        """All cells, ``num`` along the longest edge."""
        return Cells(box, torch.ones(box.counts(num), dtype=torch.bool))

    @property
    def edge(self) -> float:
        """Edge [m] of a cell."""
        return self.box.edge / max(self.occupied.shape)

    def to(self, place: torch.device) -> Cells:
        """The same cells in the memory of a device."""
        return Cells(self.box, self.occupied.to(place))

    def centres(self) -> Tensor:
        """Positions (cells, 3) [m] of all cell centres, float32."""
        shape = self.occupied.shape
        axes = [low + (np.arange(n) + 0.5) * size / n
                for low, size, n in zip(self.box.low, self.box.size, shape, strict=True)]  # fmt: skip
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        return torch.as_tensor(grid, dtype=torch.float32, device=self.occupied.device)

    def refined(self, opacity: Tensor, least: float, margin: float) -> Cells:
        """Cells whose opacity (cells,) is at least ``least`` and those within ``margin`` [m] of them."""
        filled = (opacity.view(self.occupied.shape) >= least).cpu().numpy()
        reach = np.ceil(margin * np.array(filled.shape) / self.box.size).astype(int)
        occupied = binary_dilation(filled, np.ones(tuple(2 * reach + 1), dtype=bool))
        return Cells(self.box, torch.from_numpy(occupied).to(opacity.device))

    @torch.no_grad()
    def samples(self, paths: Paths, num: int, *, jitter: bool) -> Samples:
        """``num`` samples a path, spread evenly over its occupied part, or over the whole path if none is occupied."""
        if self.occupied.all():
            # Equal pieces of each path, shifted as by `samples_by_mass`.
            near, length = paths.near[:, None], ((paths.far - paths.near) / num)[:, None]
            number = torch.arange(num + 1, device=near.device)
            shift = torch.rand(len(paths), 1, device=near.device) if jitter else near.new_full((len(paths), 1), 0.5)
            return Samples(near + (number[:-1] + shift) * length, length.expand(-1, num), near + number * length)
        share = torch.linspace(0.0, 1.0, BINS + 1, device=paths.near.device)
        edges = paths.near[:, None] + share * (paths.far - paths.near)[:, None]
        inside = self.holds(paths.at(0.5 * (edges[:, 1:] + edges[:, :-1])))
        return samples_by_mass(edges, inside.to(torch.float32), num, jitter, dense=False)

    def holds(self, x: Tensor) -> Tensor:
        """Whether positions (..., 3) [m] lie in an occupied cell, (...) bool."""
        shape = torch.tensor(self.occupied.shape, device=x.device)
        index = torch.floor(self.box.unit(x) * shape).long()
        inside = ((index >= 0) & (index < shape)).all(dim=-1)
        index = torch.minimum(index.clamp(min=0), shape - 1)
        flat = (index[..., 0] * shape[1] + index[..., 1]) * shape[2] + index[..., 2]
        return inside & self.occupied.view(-1)[flat]


MIN_COLOUR_WEIGHT = 1e-2  # Colour is looked up only where a sample matters (MDW-NeRF)


def log_transmittance(distance: Tensor, width: Tensor) -> Tensor:
    """Logarithm of the share of light that comes down to a signed distance [m], positive above the bed.

    The share is the Laplace distribution function, ``1 - exp(-d / width) / 2`` above the bed and ``exp(d / width) / 2``
    below it, so that the density tends to 1 / width inside, as in VolSDF. There that function is the density itself,
    which puts the middle of the weights 0.34 widths under the bed; here (as in NeuS) it lies on the bed, for any width.
    """
    above = torch.log1p(-0.5 * torch.exp(-distance.clamp(min=0.0) / width))
    return above + distance.clamp(max=0.0) / width


def render_weights(thickness: Tensor) -> Tensor:
    """Weights w_i = T_i (1 - exp(-thickness_i)) of samples (rays, samples), in the order of travel.

    ``thickness`` is the density times the length of each sample, and T_i what those before it let pass. Weights sum to
    at most 1; what is missing passed through.
    """
    # Not the sum less the sample's own: of an opaque sample rounding would leave nothing of those before it.
    before = nn.functional.pad(torch.cumsum(thickness[:, :-1], dim=1), (1, 0))
    return torch.exp(-before) * -torch.expm1(-thickness)


def with_opaque_end(weights: Tensor, meets: Tensor | float = 1.0) -> Tensor:
    """Weights (rays, samples) whose last sample takes all light that passes the others: every ray ends there.

    ``meets`` (rays, 1) is zero for rays that meet nothing at all.
    """
    remaining = (1.0 - weights[:, :-1].sum(dim=1, keepdim=True)) * meets
    return torch.cat([weights[:, :-1], remaining], dim=1)


def composite(weights: Tensor, radiance_of: Callable[[Tensor], Tensor], opacity: Tensor | None = None) -> Tensor:
    """Linear radiance (rays, 3) of samples with weights (rays, samples), times the opacity (rays, 1), 1 where None.

    ``radiance_of`` gives the colours (n, 3) of the samples at flat indices (n,). Samples too light to be looked up take
    the others' colour: left black, they would push a bed about, and darken what is thin. Of many samples half their
    mean weight counts, so that light fog has a colour, too.
    """
    least = min(MIN_COLOUR_WEIGHT, 0.5 / weights.shape[1])
    painted = weights.detach() > least
    where = painted.view(-1).nonzero()[:, 0]
    colours = weights.new_zeros(weights.numel(), 3).index_put((where,), radiance_of(where)).view(*weights.shape, 3)
    share = weights * painted
    total = share.sum(dim=1, keepdim=True)
    share = share / total if opacity is None else share * (opacity / total.clamp(min=least))
    return (share[..., None] * colours).sum(dim=1)


def quantile_height(weights: Tensor, edges: Tensor, level: float = 0.5) -> Tensor:
    """Height [m] at which the accumulated weight of each ray passes a level of its total; linear inside an interval.

    ``weights`` (rays, samples). ``edges`` (rays, samples + 1) [m]: heights of the intervals' ends, in the order of
    travel.
    """
    total = torch.cumsum(weights, dim=1)
    target = level * total[:, -1:]
    index = (total < target).sum(dim=1, keepdim=True).clamp(max=weights.shape[1] - 1)
    weight = weights.gather(1, index)
    before = total.gather(1, index) - weight
    share = ((target - before) / weight.clamp(min=1e-12)).clamp(0.0, 1.0)
    start, end = edges.gather(1, index), edges.gather(1, index + 1)
    return (start + share * (end - start))[:, 0]
