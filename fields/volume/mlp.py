"""Perceptrons of positions: NeRF and TinyNeRF, one model with two settings, and ground planes with one beside them.

    h = trunk(gamma(x)), relu after each layer;  density = softplus of a linear map of h                         (1)
    colour = a linear map of relu(W [V h, gamma(d)]);  of a matt scene, of h alone                               (2)

Mildenhall et al. 2020, figure 7; gamma is `frequency_encoding`. Different here: softplus instead of relu, which can die
over a whole box (mip-NeRF); radiance is linear light and may exceed 1; there is one network, and the sampler decides
where it is evaluated.

Sines of coordinates let a perceptron resolve fine detail (Mildenhall et al. 2020, section 5.1):

    gamma_L(p) = (p, sin(2^0 pi p), cos(2^0 pi p), ..., sin(2^(L-1) pi p), cos(2^(L-1) pi p)), p in [-1, 1]      (3)

p itself goes along, as in the authors' code: sines alone read the same at both ends of the box.

Ground-feature planes and a perceptron beside them are for scenes that are wide and flat (Grid-NeRF, Xu et al. 2023):

    F      = [v_n(z) M_n(x, y)], n = 1..L: factors of one direction, planes over the ground of L resolutions        (4)
    grid   : density by a linear map of F, colour by a perceptron of F and the direction                           (5)
    NeRF   : density and colour by a perceptron of F and sines of the position                                     (6)
    L_grid = mean squared error of colours by (5), beside that of (6), in the same step                            (7)

Training has two stages, as in the paper: (5) alone until `joint_from`, then (6), which begins as (5): what its
perceptron says is added to raw density and colour, and is zero at first. (7) keeps the planes what they are for (5).
Different here: in each step of the second stage one of the branches is rendered, (5) in one of four, since
photographs are compared once a step; planes and vectors of every scale are those of `fields.factors`.
"""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from fields.device import Device
from fields.factors import Factors, geometric_scales
from fields.heads import conditions_of, perceptron
from fields.volume.model import Rates, Setup, VolumeModel, density_of
from fields.volume.paths import Box
from fields.volume.tensor import grid_of


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


GRID_EVERY = 4  # Of the steps of the second stage, one in so many renders the branch of planes


@dataclass(frozen=True)
class GroundPlaneSettings:
    scales: int = 3  # L
    channels: int = 8  # Of each plane, a multiple of 4
    n_min: int = 16  # Cells along the longest edge at the coarsest scale
    n_max: int = 64  # And at the finest
    hidden: int = 64  # Of the perceptrons
    frequencies: int = 6  # Octaves of the sines of the position
    degree: int = 2  # Of the harmonics of the direction; 0 for a matt scene
    joint_from: float = 0.4  # Share of the steps after which (6) is trained
    steps: int = 2000  # Of the training


class GroundPlaneVolume(VolumeModel):
    """Density and colour by (5), and from the second stage on by (6)."""

    FACTORS, NETWORKS = 0.02, 0.001

    def __init__(self, box: Box, settings: GroundPlaneSettings, device: Device, *, appearance: int = 0):
        super().__init__(box)
        self.settings = settings
        self._step, self.is_joint = 0, False
        grids = [grid_of(box, n) for n in geometric_scales(settings.n_min, settings.n_max, settings.scales)]
        self.factors = Factors(grids, "z", settings.channels, device)
        width, hidden = self.factors.num_features, settings.hidden
        self.density = nn.Linear(width, 1)
        nn.init.ones_(self.density.weight)
        nn.init.zeros_(self.density.bias)
        seen = (settings.degree + 1) ** 2 - 1 + appearance
        self.colour = perceptron(width + seen, hidden, 3)
        inside = width + encoded_length(settings.frequencies)
        self.nerf = nn.Sequential(nn.Linear(inside, hidden), nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU())
        self.nerf_density = nn.Linear(hidden, 1)
        last_of_colour = nn.Linear(hidden, 3)
        self.nerf_colour = nn.Sequential(nn.Linear(hidden + seen, hidden), nn.ReLU(), last_of_colour)
        for last in (self.nerf_density, last_of_colour):
            nn.init.zeros_(last.weight)
            nn.init.zeros_(last.bias)

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self._of(x, joint=self.is_joint)

    def thickness(self, x: Tensor, direction: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        alone = torch.is_grad_enabled() and self._step % GRID_EVERY == 0
        density, features = self._of(x, joint=self.is_joint and not alone)
        return density * length, features

    def _of(self, x: Tensor, *, joint: bool) -> tuple[Tensor, Tensor]:
        """Density and features, planes first; those of (6) are zero where it does not count."""
        planes = self.factors(self.box.unit(x))
        raw = self.density(planes)[:, 0]
        hidden = planes.new_zeros(len(x), self.settings.hidden)
        if joint:
            position = frequency_encoding(self.box.centred(x), self.settings.frequencies)
            hidden = self.nerf(torch.cat([planes, position], dim=1))
            raw = raw + self.nerf_density(hidden)[:, 0]
        counts = planes.new_full((len(x), 1), float(joint))
        return density_of(raw, self.settings.n_max, self.box.edge), torch.cat([planes, hidden, counts], dim=1)

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        width = self.factors.num_features
        planes, hidden, counts = features[:, :width], features[:, width:-1], features[:, -1:]
        conditions = conditions_of(-direction, self.settings.degree, appearance)
        raw = self.colour(torch.cat([planes, *conditions], dim=1))
        raw = raw + counts * self.nerf_colour(torch.cat([hidden, *conditions], dim=1))
        return nn.functional.softplus(raw, beta=4.0)

    def observe(self, losses: list[float]) -> bool:
        self._step = len(losses)
        if self.is_joint or self._step < self.settings.joint_from * self.settings.steps:
            return False
        self.is_joint = True
        return True

    def rates(self) -> list[Rates]:
        factors = list(self.factors.parameters())
        others = [p for name, p in self.named_parameters() if not name.startswith("factors.")]
        return [Rates(factors, self.FACTORS), Rates(others, self.NETWORKS)]

    def get_extra_state(self) -> dict:
        return {"step": self._step, "is_joint": self.is_joint}

    def set_extra_state(self, state: dict) -> None:
        self._step, self.is_joint = state["step"], state["is_joint"]


def ground(of: Setup) -> GroundPlaneVolume:
    settings = GroundPlaneSettings(n_min=max(of.cells // 4, 2), n_max=of.cells, steps=of.steps)
    return GroundPlaneVolume(of.box, settings, of.device, appearance=of.appearance)
