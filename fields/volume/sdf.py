"""A signed distance and the light that it stops: NeuS (Wang et al. 2021, equation numbers theirs).

    Phi(f) = 1 / (1 + exp(-s f)), s learned;  density = max(-(dPhi/dt) / Phi, 0) = s (1 - Phi(f)) max(-cos, 0)      (10)
    alpha  = max((Phi(f_i) - Phi(f_i+1)) / Phi(f_i), 0) of a piece of path between f_i and f_i+1                    (13)
    f_i, f_i+1 = f(x) -+ length / 2 cos, cos = grad f . direction of travel, x the middle of the piece
    eikonal = mean of (|grad f| - 1)^2                                                                              (16)

f [m] is positive outside, s in 1/m. The weights of a path that meets a surface have their middle on it, for any s.
Early in training cos is annealed, so that surfaces that face away are not lost: with a share r of the annealing done

    cos' = -((1 - r) max((1 - cos) / 2, 0) + r max(-cos, 0))        (the authors' code; r = 1: equation 13 as it stands)

Left out: the second, finer round of samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from fields.training import Rates
from fields.volume.mlp import encoded_length, frequency_encoding
from fields.volume.model import Setup, VolumeModel
from fields.volume.paths import Box

# Samples differentiated at once without training: 1 GB of activations in the paper's network.
CHUNK = 1 << 15


@dataclass(frozen=True)
class SdfSettings:
    """Settings of a signed-distance volume; the defaults are those of NeuS.

    Attributes
    ----------
    layers, colour_layers : int
        Of the distance network and of the colour network.
    """

    layers: int = 8
    width: int = 256  # Of both, and length of the features between them
    skip: int | None = 4  # The encoded position joins the input of this layer, counted from 0
    # frequencies, direction_frequencies: Of positions and directions
    frequencies: int = 6
    direction_frequencies: int = 4
    colour_layers: int = 4
    # "sphere" or "plane": the untrained surface, about the middle of the box: closed, or level with water above
    start: str = "sphere"
    start_at: float = 0.5  # Radius of the sphere or height of the plane over the middle, in halves of the longest edge
    sharpness: float = 0.3  # The untrained ``s`` is ``exp(10 sharpness)`` per half of the longest edge
    eikonal: float = 0.1  # Weight of the eikonal term in training
    annealed: float = 0.0  # Share of the steps over which cos is annealed
    steps: int = 2000  # Of the training

    def __post_init__(self):
        if self.start not in ("sphere", "plane"):
            raise ValueError(f"start is {self.start!r}, expected 'sphere' or 'plane'")
        if self.skip is not None and not 0 < self.skip < self.layers:
            raise ValueError(f"skip is {self.skip}, expected a layer from 1 to {self.layers - 1}, or None")
        if self.skip is not None and self.width <= encoded_length(self.frequencies):
            raise ValueError(
                f"width is {self.width}, but at the skip {encoded_length(self.frequencies)} of it hold the encoded "
                f"position; widen the network or take skip = None"
            )

    @staticmethod
    def neus(**changes) -> SdfSettings:
        """The networks of Wang et al. 2021."""
        return replace(SdfSettings(), **changes)

    @staticmethod
    def small(**changes) -> SdfSettings:
        """Networks for a CPU: 4 layers of 64 for distance, 2 for colour."""
        return replace(SdfSettings(4, 64, None, colour_layers=2), **changes)


class DistanceNetwork(nn.Module):
    """Signed distance and features (S, 1 + width) of box coordinates p (S, 3), in the unit of p.

    Softplus of beta 100, weight normalisation, and the geometric initialisation of Atzmon and Lipman 2020: sines count
    for nothing at first, and a wide network begins as the distance to a sphere.
    """

    def __init__(self, settings: SdfSettings):
        super().__init__()
        self.settings = settings
        position, width = encoded_length(settings.frequencies), settings.width
        layers = []
        for index in range(settings.layers + 1):
            last = index == settings.layers
            out = 1 + width if last else width - (position if index + 1 == settings.skip else 0)
            layer = nn.Linear(width if index else position, out)
            spread = 1e-4 if last else math.sqrt(2.0 / out)
            mean = math.sqrt(math.pi / width) if last and settings.start == "sphere" else 0.0
            nn.init.normal_(layer.weight, mean, spread)
            nn.init.constant_(layer.bias, -settings.start_at if last else 0.0)
            if index in (0, settings.skip):
                nn.init.zeros_(layer.weight[:, layer.in_features - (position - 3) :])
            layers.append(weight_norm(layer))
        self.layers = nn.ModuleList(layers)

    def forward(self, p: Tensor) -> Tensor:
        position = frequency_encoding(p, self.settings.frequencies)
        h = position
        for index, layer in enumerate(self.layers):
            if index == self.settings.skip:
                h = torch.cat([h, position], dim=1) / math.sqrt(2.0)
            h = layer(h)
            if index < self.settings.layers:
                h = nn.functional.softplus(h, beta=100.0)
        if self.settings.start == "plane":
            return torch.cat([h[:, :1] + p[:, 2:], h[:, 1:]], dim=1)
        return h


class SdfVolume(VolumeModel):
    """A signed distance, its logistic density, and colour; drawn from torch's generator.

    Parameters
    ----------
    box : Box
    settings : SdfSettings
    appearance : int
        Length of the appearance vectors; 0 without.
    """

    RATE = 5e-4

    def __init__(self, box: Box, settings: SdfSettings, *, appearance: int = 0):
        super().__init__(box)
        self.settings, self._step = settings, 0
        self.network = DistanceNetwork(settings)
        self.raw_sharpness = nn.Parameter(torch.tensor(settings.sharpness))
        width = settings.width
        seen = 3 + 3 + width + encoded_length(settings.direction_frequencies) + appearance
        layers = []
        for index in range(settings.colour_layers):
            layers += [weight_norm(nn.Linear(width if index else seen, width)), nn.ReLU()]
        self.colour = nn.Sequential(*layers, weight_norm(nn.Linear(width, 3)))

    @property
    def sharpness(self) -> Tensor:
        """s [1/m]."""
        return torch.exp(10.0 * self.raw_sharpness) * (2.0 / self.box.edge)

    def distance(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Signed distance (S,) [m], its gradient (S, 3) and features (S, 6 + width) at positions (S, 3) [m], local.

        No gradient flows to `x`.
        """
        pieces = x.detach().split(max(len(x), 1) if torch.is_grad_enabled() else CHUNK)
        f, gradient, features = (torch.cat(parts) for parts in zip(*map(self._distance, pieces), strict=True))
        return f, gradient, features

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Density (S,) [1/m] where it is looked at head-on, and features (S, 6 + width)."""
        f, _, features = self.distance(x)
        return self.sharpness * torch.sigmoid(-self.sharpness * f), features

    def thickness(self, x: Tensor, direction: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        f, gradient, features = self.distance(x)
        half = 0.5 * length * self._annealed((gradient * direction).sum(dim=1))
        before, after = (nn.functional.logsigmoid(self.sharpness * end) for end in (f - half, f + half))
        return (before - after).clamp(min=0.0), features

    def _annealed(self, cos: Tensor) -> Tensor:
        """cos' of cos (S,); cos itself once the annealing is over."""
        over = self.settings.annealed * self.settings.steps
        if self._step >= over:
            return cos
        done = self._step / over
        return -((1.0 - done) * (0.5 - 0.5 * cos).clamp(min=0.0) + done * (-cos).clamp(min=0.0))

    def observe(self, losses: list[float]) -> bool:
        self._step = len(losses)
        return False

    def get_extra_state(self) -> dict:
        return {"step": self._step}

    def set_extra_state(self, state: dict) -> None:
        self._step = state["step"]

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        seen = [features, frequency_encoding(direction, self.settings.direction_frequencies)]
        if appearance is not None:
            seen.append(appearance)
        return nn.functional.softplus(self.colour(torch.cat(seen, dim=1)), beta=4.0)

    def penalty(self, x: Tensor) -> Tensor:
        """The eikonal term, equation 16, times its weight."""
        length = self.distance(x)[1].norm(dim=1)
        return self.settings.eikonal * ((length - 1.0) ** 2).mean()

    def normals(self, x: Tensor, step: float) -> Tensor:
        """Outward unit normals (S, 3): the gradient of the distance, exact; there is no ``step``."""
        return nn.functional.normalize(self.distance(x)[1], dim=1)

    def density_gradient(self, x: Tensor, step: float) -> Tensor:
        """Gradient (S, 3) [1/m2] of the density of `evaluate`, exact; there is no ``step``."""
        f, gradient, _ = self.distance(x)
        s = self.sharpness
        return -((s * s) * torch.sigmoid(s * f) * torch.sigmoid(-s * f))[:, None] * gradient

    def rates(self) -> list[Rates]:
        return [Rates(list(self.parameters()), self.RATE)]

    def _distance(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        learns = torch.is_grad_enabled()
        with torch.enable_grad():
            p = self.box.centred(x).requires_grad_(True)
            out = self.network(p)
            (gradient,) = torch.autograd.grad(out[:, 0].sum(), p, create_graph=learns)
        if not learns:
            out = out.detach()
        # A length in p is one of edge / 2 in metres, so that the gradient is the same in both.
        return out[:, 0] * (0.5 * self.box.edge), gradient, torch.cat([p.detach(), gradient, out[:, 1:]], dim=1)


# Share of the steps over which NeuS anneals: 50,000 of 300,000 as published.
ANNEALED = 1 / 6


def neus(of: Setup) -> SdfVolume:
    """The model of a setup. A bed is open, with water above: it begins as a level surface."""
    settings = SdfSettings.small(start="plane", start_at=0.0, annealed=ANNEALED, steps=of.steps)
    return SdfVolume(of.box, settings, appearance=of.appearance)
