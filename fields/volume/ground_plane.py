"""Ground-feature planes and a perceptron beside them, for scenes that are wide and flat (Grid-NeRF, Xu et al. 2023).

    F      = [v_n(z) M_n(x, y)], n = 1..L: factors of one direction, planes over the ground of L resolutions        (1)
    grid   : density by a linear map of F, colour by a perceptron of F and the direction                           (2)
    NeRF   : density and colour by a perceptron of F and sines of the position                                     (3)
    L_grid = mean squared error of colours by (2), beside that of (3), in the same step                            (4)

Training has two stages, as in the paper: (2) alone until `joint_from`, then (3), which begins as (2): what its
perceptron says is added to raw density and colour, and is zero at first. (4) keeps the planes what they are for (2).
Different here: in each step of the second stage one of the branches is rendered, (2) in one of four, since
photographs are compared once a step; planes and vectors of every scale are those of `fields.factors`.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fields.device import Device
from fields.factors import Factors, geometric_scales
from fields.heads import perceptron, spherical_harmonics
from fields.volume.mlp import encoded_length, frequency_encoding
from fields.volume.model import Rates, Setup, VolumeModel, density_of
from fields.volume.paths import Box
from fields.volume.tensor import grid_of

GRID_EVERY = 4  # Of the steps of the second stage, one in so many renders the branch of planes


@dataclass(frozen=True)
class GroundPlaneSettings:
    """Settings of a ground-plane volume."""

    scales: int = 3  # L
    channels: int = 8  # Of each plane, a multiple of 4
    n_min: int = 16  # Cells along the longest edge at the coarsest scale
    n_max: int = 64  # And at the finest
    hidden: int = 64  # Of the perceptrons
    frequencies: int = 6  # Octaves of the sines of the position
    degree: int = 2  # Of the harmonics of the direction; 0 for a matt scene
    joint_from: float = 0.4  # Share of the steps after which (3) is trained
    steps: int = 2000  # Of the training


class GroundPlaneVolume(VolumeModel):
    """Density and colour by (2), and from the second stage on by (3)."""

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
        """Density and features, planes first; those of (3) are zero where it does not count."""
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
        conditions = [] if appearance is None else [appearance]
        if self.settings.degree:
            conditions.insert(0, spherical_harmonics(-direction, self.settings.degree))
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
    """The model of a setup."""
    settings = GroundPlaneSettings(n_min=max(of.cells // 4, 2), n_max=of.cells, steps=of.steps)
    return GroundPlaneVolume(of.box, settings, of.device, appearance=of.appearance)
