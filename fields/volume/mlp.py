"""Positions through sines and a multilayer perceptron: NeRF and TinyNeRF are one model with two settings.

    h = trunk(gamma(x)), relu after each layer;  density = softplus of a linear map of h                         (1)
    colour = a linear map of relu(W [V h, gamma(d)]);  of a matt scene, of h alone                               (2)

Mildenhall et al. 2020, figure 7; gamma is `frequency_encoding`. Different here: softplus instead of relu, which can die
over a whole box (mip-NeRF); radiance is linear light and may exceed 1; there is one network, and the sampler decides
where it is evaluated.

Sines of coordinates let a perceptron resolve fine detail (Mildenhall et al. 2020, section 5.1):

    gamma_L(p) = (p, sin(2^0 pi p), cos(2^0 pi p), ..., sin(2^(L-1) pi p), cos(2^(L-1) pi p)), p in [-1, 1]      (3)

p itself goes along, as in the authors' code: sines alone read the same at both ends of the box.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from fields.volume.model import Rates, Setup, VolumeModel, density_of
from fields.volume.paths import Box


def encoded_length(frequencies: int) -> int:
    """Length of gamma_L of three coordinates."""
    return 3 + 6 * frequencies


def frequency_encoding(p: Tensor, frequencies: int) -> Tensor:
    """Equation (3) of coordinates (S, 3): (S, 3 + 6 L), the coordinates, all their sines, all their cosines."""
    waves = torch.pi * 2.0 ** torch.arange(frequencies, dtype=p.dtype, device=p.device)
    angle = (p[:, None, :] * waves[:, None]).flatten(1)
    return torch.cat([p, torch.sin(angle), torch.cos(angle)], dim=1)


@dataclass(frozen=True)
class MlpSettings:
    """Settings of a perceptron volume; the defaults are those of NeRF."""

    # layers, width: Of the trunk
    layers: int = 8
    width: int = 256
    skip: int | None = 4  # The encoded position joins the activation of this layer, counted from 0
    # frequencies, direction_frequencies: L of positions and of directions; 0 of directions for a matt scene
    frequencies: int = 10
    direction_frequencies: int = 4
    rate: float = 5e-4  # Of Adam


class MlpVolume(VolumeModel):
    """Density and colour of a perceptron, drawn from torch's generator.

    Density is ``softplus`` per half the shortest wave, ``edge / 2^L`` [m], the finest detail that the encoding
    resolves; an untrained box lets about 1/e of the light through along its longest edge.
    """

    def __init__(self, box: Box, settings: MlpSettings, *, appearance: int = 0):
        super().__init__(box)
        self.settings = settings
        width, position = settings.width, encoded_length(settings.frequencies)
        widths = [position] + [width + (position if i == settings.skip else 0) for i in range(settings.layers - 1)]
        self.trunk = nn.ModuleList(nn.Linear(w, width) for w in widths)
        self.density = nn.Linear(width, 1)
        if settings.direction_frequencies:
            self.bottleneck = nn.Linear(width, width)
            seen = width + encoded_length(settings.direction_frequencies) + appearance
            self.colour: nn.Module = nn.Sequential(nn.Linear(seen, width // 2), nn.ReLU(), nn.Linear(width // 2, 3))
        else:
            self.colour = nn.Linear(width + appearance, 3)

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        settings = self.settings
        position = frequency_encoding(self.box.centred(x), settings.frequencies)
        h = position
        for index, layer in enumerate(self.trunk):
            h = torch.relu(layer(h))
            if index == settings.skip:
                h = torch.cat([position, h], dim=1)
        return density_of(self.density(h)[:, 0], 2.0**settings.frequencies, self.box.edge), h

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        seen = [features]
        if self.settings.direction_frequencies:
            seen = [self.bottleneck(features), frequency_encoding(direction, self.settings.direction_frequencies)]
        if appearance is not None:
            seen.append(appearance)
        return nn.functional.softplus(self.colour(torch.cat(seen, dim=1)), beta=4.0)

    def rates(self) -> list[Rates]:
        return [Rates(list(self.parameters()), self.settings.rate)]


def _of_setup(of: Setup, settings: MlpSettings) -> MlpVolume:
    return MlpVolume(of.box, settings, appearance=of.appearance)


# The models, each made of a setup: the network of Mildenhall et al. 2020, and three layers of 128, matt.
nerf = partial(_of_setup, settings=MlpSettings())
tinynerf = partial(_of_setup, settings=MlpSettings(3, 128, None, 6, 0, 5e-3))
