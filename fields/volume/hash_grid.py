"""Features hashed over many resolutions: Instant-NGP (Mueller et al. 2022).

    N_l  = N_min b^l rounded, b = (N_max / N_min)^(1/(L-1)), l = 0..L-1: cells along the longest edge             (1)
    row  = i_x + (n_x + 1) (i_y + (n_y + 1) i_z)    where the (n_x+1)(n_y+1)(n_z+1) nodes of a level fit its table
    row  = (i_x xor 2654435761 i_y xor 805459861 i_z) mod 2^T    elsewhere: nodes share rows                      (2)
    f_l  = the features at the 8 nodes about a sample, weighted linearly along x, y and z                         (3)

Nodes lie at cell corners. Cells are nearly cubes: a flat box has fewer along its height, and more dense levels.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fields.factors import geometric_scales
from fields.volume.paths import Box
from fields.volume.tensor import grid_of

PRIMES = (1, 2654435761, 805459861)
PER_LEVEL = 2


class HashGrid(nn.Module):
    """Features (2 a level) of positions in a box, drawn from torch's generator.

    Parameters
    ----------
    box : Box
    levels, log2_table : int
        L and T.
    n_min, n_max : int
        Cells along the longest edge at the coarsest and the finest level.
    """

    cells: Tensor
    strides: Tensor
    first: Tensor

    def __init__(self, box: Box, levels: int, log2_table: int, n_min: int, n_max: int):
        super().__init__()
        grids = [grid_of(box, round(n)) for n in geometric_scales(n_min, n_max, levels)]
        cells = torch.tensor([(g.nx, g.ny, g.nz) for g in grids]).T
        nodes = (cells + 1).prod(dim=0)
        self.num_dense = int((nodes <= 2**log2_table).sum())
        self.mask = 2**log2_table - 1
        strides = torch.tensor(PRIMES)[:, None].repeat(1, levels)
        nx, ny, _ = cells[:, : self.num_dense] + 1
        strides[:, : self.num_dense] = torch.stack([torch.ones_like(nx), nx, nx * ny])
        rows = nodes.clamp(max=2**log2_table)
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("strides", strides, persistent=False)
        self.register_buffer("first", torch.cumsum(rows, 0) - rows, persistent=False)
        self.table = nn.Parameter(torch.empty(int(rows.sum()), PER_LEVEL).uniform_(-1e-4, 1e-4))

    def rows(self, corner: Tensor) -> Tensor:
        """Equation (2): rows (8, L, S) int32 of the nodes about cells whose lowest nodes are ``corner`` (3, L, S).

        Rows of a level count from its first. Of each product only the last T bits count, in sums too: those fit.
        """
        nodes = torch.stack([corner, corner + 1], dim=1) * self.strides[:, None, :, None] & self.mask
        x, y, z = nodes.int()
        x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
        d = self.num_dense
        dense = x[..., :d, :] + y[..., :d, :] + z[..., :d, :]
        hashed = x[..., d:, :] ^ y[..., d:, :] ^ z[..., d:, :]
        return torch.cat([dense, hashed], dim=-2).flatten(0, 2)

    def forward(self, u: Tensor) -> Tensor:
        """Features (S, L * 2) at box coordinates u (S, 3) in [0, 1]; outside, those of the border.

        No gradient flows to `u`. That of the table is summed in one order on any number of threads.
        """
        x = u.detach().clamp(0.0, 1.0).T[:, None] * self.cells[..., None]
        corner = torch.minimum(x.long(), self.cells[..., None] - 1)
        share = x - corner
        wx, wy, wz = torch.stack([1.0 - share, share], dim=1)
        weights = (wx[:, None, None] * wy[None, :, None] * wz[None, None, :]).flatten(0, 2)
        rows = self.rows(corner) + self.first.int()[:, None]
        # A pair of features travels as one complex number: the table is passed once, and its gradient is a plain loop.
        pairs = torch.view_as_complex(self.table).index_select(0, rows.view(-1)).view(weights.shape)
        features = (torch.view_as_real(pairs) * weights[..., None]).sum(dim=0)
        return features.transpose(0, 1).flatten(1)
