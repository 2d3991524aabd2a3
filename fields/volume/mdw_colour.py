"""Colour of MDW-NeRF as the paper prints it.

    f_c = [G_n W_n], n = 1..L: products by element, W_n (D F numbers) of the position                             (1)
    c   = CRN(f_c, SH(d)): linear to N_c numbers, three times linear and GELU, linear to the three colours          (2)

The text does not say how W_n depends on the position; here it is a vector along each direction, as v_n of the factors,
in cells of the same size and linear between their middles. `fields.heads.ColourHead` has W_n constant and two hidden
maps, with which the field learns faster.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from fields.factors import Grid, nodes_of
from fields.heads import spherical_harmonics
from fields.lookup import axes_of


class ScaleWeights(nn.Module):
    """W_n of all scales: (samples, L D F) at box coordinates (samples, 3), one until it has learned."""

    def __init__(self, grids: list[Grid], directions: str, channels: int):
        super().__init__()
        self.axes = [(grid.along(axis), axis) for grid in grids for axis in (axes_of(m)[0] for m in directions)]
        self.vectors = nn.Parameter(torch.ones(sum(cells for cells, _ in self.axes), channels))

    def forward(self, u: Tensor) -> Tensor:
        found, first = [], 0
        for cells, axis in self.axes:
            left, right, share = nodes_of(u[:, axis], cells)
            found.append(torch.lerp(self.vectors[first + left], self.vectors[first + right], share))
            first += cells
        return torch.cat(found, dim=1)


class PrintedColour(nn.Module):
    """Equation (2): linear radiance (samples, 3), at least 0, of features (1), seen along unit directions."""

    def __init__(self, width: int, *, hidden: int, degree: int, extra: int):
        super().__init__()
        self.degree = degree
        layers: list[nn.Module] = [nn.Linear(width + (degree + 1) ** 2 - 1 + extra, hidden)]
        for _ in range(3):
            layers += [nn.Linear(hidden, hidden), nn.GELU()]
        self.network = nn.Sequential(*layers, nn.Linear(hidden, 3))

    def forward(self, features: Tensor, directions: Tensor | None, appearance: Tensor | None = None) -> Tensor:
        known = [features]
        if directions is not None:
            known.append(spherical_harmonics(directions, self.degree))
        if appearance is not None:
            known.append(appearance)
        return nn.functional.softplus(self.network(torch.cat(known, dim=1)), beta=4.0)
