"""Samples along a path: in the occupied cells of a proxy, or by the weights of another field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from torch import Tensor

from fields.volume.paths import Box, Paths

# Cells of the proxy are looked up this often along a path.
BINS = 128


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

    Parameters
    ----------
    bin_edges, mass : (N, B + 1) [m], (N, B)
        A path without mass is sampled evenly.
    jitter : bool
        Shift all samples of a path by the same random share of a step.
    dense : bool
        Bins without mass are part of the volume (proposal sampling); else they are empty, and a piece counts the length
        of the bins with mass that it covers.
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
            return _even_samples(paths, num, jitter=jitter)
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


def _even_samples(paths: Paths, num: int, *, jitter: bool) -> Samples:
    """``num`` samples of equal pieces of each path, shifted as by `samples_by_mass`."""
    near, length = paths.near[:, None], ((paths.far - paths.near) / num)[:, None]
    number = torch.arange(num + 1, device=near.device)
    shift = torch.rand(len(paths), 1, device=near.device) if jitter else near.new_full((len(paths), 1), 0.5)
    return Samples(near + (number[:-1] + shift) * length, length.expand(-1, num), near + number * length)
