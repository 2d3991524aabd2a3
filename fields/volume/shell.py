"""Shell about the box for the scene outside, in which distance is replaced by its inverse.

Positions are measured from the centre of an ellipsoid about the box, in its semi-axes, so that it is the unit sphere.
At distance r >= 1 a point becomes (x', y', z', u): the point of the sphere below it and u = 1 / r (NeRF++, Zhang et al.
2020, after it the NeRF of tidal flats). A straight path ``o + t d`` with unit d meets distance 1 / u at

    t = -b + sqrt(b^2 - |o|^2 + 1 / u^2),  b = o . d                                                              (1)
    (x', y', z') = u (o + t d) = u o + (sqrt(1 + u^2 (b^2 - |o|^2)) - u b) d                                      (2)

which is finite at u = 0: infinitely far away, where it is d, the direction alone.
"""

import numpy as np
import torch
from torch import Tensor, nn

from fields.heads import conditions_of, perceptron
from fields.volume.paths import Box, Paths

OCTAVES, HIDDEN = 5, 64  # Octaves in which the coordinates enter the networks, and their width
FEATURES, DEGREE = 15, 2  # Numbers that density hands on to colour, and degree of the harmonics of the direction
LAYERS = 8  # Samples of each path between the ellipsoid and infinity, even in u


class Shell(nn.Module):
    """Colour and density about a box, to infinity; the background of a `VolumeRenderer`.

    Colour depends on the direction and on ``appearance`` numbers of the photograph, as in the NeRF of tidal flats.
    Paths go on from where they leave the box, or from where they enter the water if that comes later, in the medium
    that is there. Thickness is density times length in the coordinates (x', y', z', u); what passes it comes from
    infinity. The corners of the box lie on the ellipsoid.
    """

    centre: Tensor
    axes: Tensor

    def __init__(self, box: Box, appearance: int = 0):
        super().__init__()
        centre, axes = 0.5 * (box.low + box.high), 0.5 * np.sqrt(3.0) * box.size
        self.register_buffer("centre", torch.as_tensor(centre, dtype=torch.float32))
        self.register_buffer("axes", torch.as_tensor(axes, dtype=torch.float32))
        self.network = perceptron(4 * (1 + 2 * OCTAVES), HIDDEN, HIDDEN, 1 + FEATURES, activation=nn.GELU)
        seen = FEATURES + (DEGREE + 1) ** 2 - 1 + appearance
        self.colour = perceptron(seen, HIDDEN, 3, activation=nn.GELU)

    def forward(self, paths: Paths, appearance: Tensor | None = None) -> Tensor:
        """Linear radiance (N, 3) from outside the box, for the appearance vectors (N, A) of the photographs."""
        origin, direction = self.scaled(paths)
        nearest = self.first(origin, direction)
        ends = nearest[:, None] * torch.linspace(1.0, 0.0, LAYERS + 1, device=nearest.device)
        middle = torch.cat([0.5 * (ends[:, 1:] + ends[:, :-1]), nearest.new_zeros(len(paths), 1)], dim=1)
        raw = self.network(octaves(inverted(origin, direction, middle)))
        known = torch.cat(conditions_of(-direction, DEGREE, appearance), dim=1)[:, None].expand(-1, LAYERS + 1, -1)
        colour = nn.functional.softplus(self.colour(torch.cat([raw[..., 1:], known], dim=-1)), beta=4.0)
        corners = inverted(origin, direction, ends)
        length = (corners[:, 1:] - corners[:, :-1]).norm(dim=-1)
        thickness = torch.cumsum(nn.functional.softplus(raw[:, :-1, 0]) * length, dim=1)
        ones, nothing = nearest.new_ones(len(paths), 1), nearest.new_zeros(len(paths), 1)
        passed = torch.cat([ones, torch.exp(-thickness), nothing], dim=1)
        return ((passed[:, :-1] - passed[:, 1:])[..., None] * colour).sum(dim=1)

    def scaled(self, paths: Paths) -> tuple[Tensor, Tensor]:
        """Starts (N, 3) and unit directions (N, 3) of paths outside the box, in semi-axes from the centre."""
        dry = torch.isinf(paths.crossing)
        start = torch.maximum(paths.far, torch.where(dry, 0.0, paths.crossing))
        direction = torch.where(dry[:, None], paths.air, paths.wet) / self.axes
        origin = (paths.at(start[:, None])[:, 0] - self.centre) / self.axes
        return origin, nn.functional.normalize(direction, dim=1)

    @staticmethod
    def first(origin: Tensor, direction: Tensor) -> Tensor:
        """u (N,) at which paths begin: 1 on the ellipsoid, less for those that start or pass outside it."""
        closest = (-(origin * direction).sum(dim=1)).clamp(min=0.0)
        return 1.0 / (origin + closest[:, None] * direction).norm(dim=1).clamp(min=1.0)


def inverted(origin: Tensor, direction: Tensor, u: Tensor) -> Tensor:
    """Coordinates (x', y', z', u) (N, K, 4) of paths (N, 3), (N, 3) at inverse distances u (N, K); equation (2)."""
    b = (origin * direction).sum(dim=1, keepdim=True)
    offset = b**2 - (origin**2).sum(dim=1, keepdim=True)
    # Rounding may take the closest point of a path below zero.
    along = (1.0 + u**2 * offset).clamp(min=0.0).sqrt() - u * b
    return torch.cat([u[..., None] * origin[:, None] + along[..., None] * direction[:, None], u[..., None]], dim=-1)


def octaves(x: Tensor) -> Tensor:
    """Coordinates (..., C) with sines and cosines of ``2^k x``, k = 0..OCTAVES-1: (..., C (1 + 2 OCTAVES))."""
    turned = x[..., None] * 2.0 ** torch.arange(OCTAVES, dtype=x.dtype, device=x.device)
    return torch.cat([x, turned.sin().flatten(-2), turned.cos().flatten(-2)], dim=-1)
