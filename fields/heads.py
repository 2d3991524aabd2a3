"""Heads of the tensor field: density, coarse then weighted, and colour (MDW-NeRF; equation numbers are ours).

A       features of a sample, (scales L, directions D, channels F)
coarse  linear map of the sum over directions of A: L F numbers to 1                                     (1)
fine    DWN: gate = GELU(W3 GELU(W2 GELU(W1 a))) per scale on its D F numbers a, A' = gate * a, then a linear map   (2)
        (W1 to W3 are those of all scales: the paper does not say)
colour  f_c = [G_n W_n] with one appearance vector W_n per scale; c = CRN(f_c, SH(d))                    (3)
"""

from itertools import pairwise

import torch
from torch import Tensor, nn

from fields.device import Device

GATE_OF_ONE = 1.1444507183528787  # GELU(x) = 1 at this x: as the bias of the gate it leaves the features unchanged
# The weighting network's kernel keeps a sum for each number of its maps. With this many at most it is 6 times as
# fast as torch; with 1300 hardly faster, and LLVM takes 15 s to compile it.
MOST_FUSED = 400
PART = 8192  # Samples whose colours are regressed at once: the activations between the maps stay in a processor's cache


class DensityHead(nn.Module):
    """Coarse density regression, and the density weighting network (DWN) that takes over from it.

    ``scales``, ``directions``, ``channels``: L, D and F of the features. ``reduction``: r of the paper: the gate's
    hidden width is D F / r. ``device``: Dr.Jit device for the weighting network's kernel; "torch" or None for its
    reference implementation.
    """

    def __init__(
        self, scales: int, directions: int, channels: int, reduction: int = 2, *, device: Device | None = None
    ):
        super().__init__()
        self.shape, self.device = (scales, directions, channels), device
        width = directions * channels
        hidden = max(width // reduction, 1)
        self.coarse = nn.Linear(scales * channels, 1)
        self.squeeze, self.excite = nn.Linear(width, hidden), nn.Linear(hidden, hidden)
        self.gate = nn.Linear(hidden, width)
        self.fine = nn.Linear(scales * channels, 1)
        for layer in (self.coarse, self.fine):  # the field starts as its proxy
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        self.is_fine = False

    def forward(self, features: Tensor) -> Tensor:
        """Raw density (samples,) of features (samples, L D F)."""
        if not self.is_fine:
            scales, directions, channels = self.shape
            each = self.coarse.weight.view(scales, 1, channels).expand(-1, directions, -1).reshape(1, -1)
            return nn.functional.linear(features, each, self.coarse.bias)[:, 0]
        layers = [(layer.weight, layer.bias) for layer in (self.squeeze, self.excite, self.gate)]
        numbers = sum(t.numel() for layer in layers for t in layer)
        fused = self.device is not None and self.device.module is not None and numbers <= MOST_FUSED
        if not fused or len(features) == 0:
            return self._weighted_torch(features)
        from fields.density_weighting import weighted_drjit

        return weighted_drjit(features, layers, self.fine.weight, self.shape, self.device) + self.fine.bias

    def _weighted_torch(self, features: Tensor) -> Tensor:
        """Reference implementation of the weighting network's kernel, in plain torch."""
        a = features.view(-1, *self.shape)
        flat = a.flatten(2)
        gelu = nn.functional.gelu
        weights = gelu(self.gate(gelu(self.excite(gelu(self.squeeze(flat))))))
        weighted = (flat * weights).view_as(a)
        return self.fine(weighted.sum(dim=2).flatten(1))[:, 0]

    def switch_to_fine(self) -> None:
        """Switch to the weighting network, initialised with gates of one to the same map as the coarse regression."""
        self.is_fine = True
        with torch.no_grad():
            self.fine.weight.copy_(self.coarse.weight)
            self.fine.bias.copy_(self.coarse.bias)
            nn.init.zeros_(self.gate.weight)
            nn.init.constant_(self.gate.bias, GATE_OF_ONE)


class ColourHead(nn.Module):
    """Colour weighting per scale and the colour regression network (CRN).

    ``degree``: of the spherical harmonics of the direction in the medium where the sample lies; 0 for a matt bed.
    ``extra``: length of an appearance vector; 0 without.
    """

    def __init__(
        self, scales: int, directions: int, channels: int, *, hidden: int = 32, degree: int = 0, extra: int = 0
    ):
        super().__init__()
        width = scales * directions * channels
        self.degree = degree
        self.weights = nn.Parameter(torch.ones(width))
        self.first = nn.Linear(width + ((degree + 1) ** 2 - 1) + extra, hidden)
        self.middle = nn.Linear(hidden, hidden)
        self.last = nn.Linear(hidden, 3)

    def forward(self, features: Tensor, directions: Tensor | None, appearance: Tensor | None = None) -> Tensor:
        """Linear radiance (samples, 3), at least 0, of features (samples, L D F) seen along unit directions.

        ``directions`` may be None for a matt bed; ``appearance`` (samples, extra) is the vector of the photograph of
        each sample.
        """
        known = conditions_of(directions, self.degree, appearance)
        conditions = torch.cat(known, dim=1) if known else features.new_empty(len(features), 0)
        # The colour weights go into the map that follows them: no pass over all features for them alone.
        width = len(self.weights)
        maps = (self.first.weight[:, :width] * self.weights).t(), self.first.weight[:, width:].t()
        part = max(len(features), 1) if features.is_cuda else PART
        parts = zip(features.split(part), conditions.split(part), strict=True)
        return torch.cat([self._regress(f, torch.addmm(self.first.bias, b, maps[1]), maps[0]) for f, b in parts])

    def _regress(self, features: Tensor, start: Tensor, weighted: Tensor) -> Tensor:
        """Radiance, from the first map's output for all but the features, and its weights of the features."""
        gelu = nn.functional.gelu
        hidden = gelu(self.middle(gelu(torch.addmm(start, features, weighted))))
        return nn.functional.softplus(self.last(hidden), beta=4.0)


def perceptron(*widths: int, activation: type[nn.Module] = nn.ReLU) -> nn.Sequential:
    """Linear maps from width to width, with an activation after each but the last."""
    maps = [layer for width in pairwise(widths) for layer in (nn.Linear(*width), activation())]
    return nn.Sequential(*maps[:-1])


def conditions_of(direction: Tensor | None, degree: int, appearance: Tensor | None) -> list[Tensor]:
    """What radiance depends on beside features: harmonics of directions (N, 3) to a degree, and appearance vectors."""
    if degree and direction is None:
        raise ValueError(f"harmonics of degree {degree} expect the directions of the samples, got None")
    harmonics = [] if direction is None or not degree else [spherical_harmonics(direction, degree)]
    return harmonics if appearance is None else [*harmonics, appearance]


def spherical_harmonics(d: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics of unit vectors (N, 3), degrees 1 to 3, without the constant: (N, (degree+1)^2 - 1)."""
    x, y, z = d.unbind(-1)
    terms = [0.4886025 * y, 0.4886025 * z, 0.4886025 * x]
    if degree > 1:
        terms += [1.0925484 * x * y, 1.0925484 * y * z, 0.3153916 * (3.0 * z * z - 1.0)]
        terms += [1.0925484 * x * z, 0.5462742 * (x * x - y * y)]
    if degree > 2:
        terms += [
            0.5900436 * y * (3.0 * x * x - y * y),
            2.8906114 * x * y * z,
            0.4570458 * y * (5.0 * z * z - 1.0),
            0.3731763 * z * (5.0 * z * z - 3.0),
            0.4570458 * x * (5.0 * z * z - 1.0),
            1.4453057 * z * (x * x - y * y),
            0.5900436 * x * (x * x - 3.0 * y * y),
        ]
    return torch.stack(terms, dim=-1)
