"""Multi-scale planes times vectors: the tensor field's features (MDW-NeRF, equations in RIVALS order below).

    N_n  = N_min b^(n-1),  b = (N_max / N_min)^(1/(L-1)),  n = 1..L
    G_n  = [v_n^m(x_m) * M_n^m(x_a, x_b)]  for each direction m with the other two axes a < b, element-wise products

A sample's features have the shape (scales L, directions D, channels F). Values between grid nodes are linear; nodes lie
at cell centres, so that a box of N cells has N nodes and its border half-cells are constant.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fields.device import Device
from fields.lookup import axes_of


@dataclass(frozen=True)
class Grid:
    """Cells of one scale along x, y and z."""

    nx: int
    ny: int
    nz: int

    def along(self, axis: int) -> int:
        return (self.nx, self.ny, self.nz)[axis]


def geometric_scales(n_min: float, n_max: float, count: int) -> list[float]:
    """Resolutions N_n of L scales in geometric steps, from n_min to n_max inclusive.

    The paper prints b^n, which would start above N_min and overshoot N_max; b^(n-1) meets both.
    """
    if count == 1:
        return [float(n_max)]
    return [float(n_min * (n_max / n_min) ** (n / (count - 1))) for n in range(count)]


class Factors(nn.Module):
    """Planes and vectors of all scales and directions in two flat parameters, channels last, by torch's generator.

    Parameters
    ----------
    grids : list of Grid, coarse to fine
    directions : str
        Which of "x", "y", "z" have a vector; the plane spans the other two axes.
    channels : int
        A multiple of 4 for fused lookups.
    device : Device
        Dr.Jit device for fused lookups; "torch" for the reference implementation.
    """

    def __init__(self, grids: list[Grid], directions: str, channels: int, device: Device):
        super().__init__()
        self.grids, self.directions, self.channels, self.device = list(grids), directions, channels, device
        self.tables: list[tuple[int, int, int, int, int]] = []
        planes = vectors = 0
        for grid in grids:
            for m in directions:
                axis, a, b = axes_of(m)
                self.tables.append((axis, a, b, planes, vectors))
                planes += grid.along(a) * grid.along(b)
                vectors += grid.along(axis)
        self.planes = nn.Parameter(0.1 * torch.randn(planes, channels))
        self.vectors = nn.Parameter(1.0 + 0.02 * torch.randn(vectors, channels))

    @property
    def num_features(self) -> int:
        """Scales times directions times channels."""
        return len(self.tables) * self.channels

    def cells(self) -> list[tuple[int, int, int, int, int, int, int, int]]:
        """Per scale and direction: axis, a, b, cells along each, first row in planes and in vectors."""
        rows = []
        for index, (axis, a, b, plane, vector) in enumerate(self.tables):
            grid = self.grids[index // len(self.directions)]
            rows.append((axis, a, b, grid.along(axis), grid.along(a), grid.along(b), plane, vector))
        return rows

    def forward(self, u: Tensor) -> Tensor:
        """Features (samples, scales * directions * channels) at box coordinates u (samples, 3) in [0, 1].

        Coordinates outside the box take the value at its border. No gradient flows to `u`.
        """
        if self.device.module is None or len(u) == 0:  # Dr.Jit launches nothing over nothing
            return lookup_torch(self, u.detach())
        from fields.lookup import lookup_drjit

        return lookup_drjit(self, u)


def nodes_of(u: Tensor, cells: int) -> tuple[Tensor, Tensor, Tensor]:
    """Left node, right node and the share of the right one."""
    x = (u * cells - 0.5).clamp(0.0, cells - 1.0)
    left = x.floor().long().clamp(max=max(cells - 2, 0))
    return left, (left + 1).clamp(max=cells - 1), (x - left)[:, None]


def lookup_torch(factors: Factors, u: Tensor) -> Tensor:
    """Reference implementation of the fused lookup, in plain torch."""
    features = []
    for axis, a, b, n, n_a, n_b, plane, vector in factors.cells():
        i0, i1, s = nodes_of(u[:, axis], n)
        v = torch.lerp(factors.vectors[vector + i0], factors.vectors[vector + i1], s)
        a0, a1, s_a = nodes_of(u[:, a], n_a)
        b0, b1, s_b = nodes_of(u[:, b], n_b)
        low = torch.lerp(factors.planes[plane + b0 * n_a + a0], factors.planes[plane + b0 * n_a + a1], s_a)
        high = torch.lerp(factors.planes[plane + b1 * n_a + a0], factors.planes[plane + b1 * n_a + a1], s_a)
        features.append(v * torch.lerp(low, high, s_b))
    return torch.cat(features, dim=1)


def anisotropic_grids(size: np.ndarray, finest_cell: np.ndarray, coarsening: float, count: int) -> list[Grid]:
    """Grids of a box of ``size`` (3,) [m] whose finest cells measure ``finest_cell`` (3,) [m].

    The coarsest cells are ``coarsening`` times as long; steps between are geometric. At least two cells along an axis.
    """
    grids = []
    for scale in geometric_scales(1.0 / coarsening, 1.0, count):
        cells = np.maximum(np.round(size / finest_cell * scale), 2).astype(int)
        grids.append(Grid(int(cells[0]), int(cells[1]), int(cells[2])))
    return grids
