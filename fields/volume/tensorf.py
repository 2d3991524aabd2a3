"""TensoRF at full strength: vector-matrix factors of density and of colour, refined in steps (Chen et al. 2022).

    raw     = sum over directions m and R_s channels of v_m(x_m) M_m(x_a, x_b);  density as all models here          (1)
    feature = B [v'_m M'_m], R_c channels for each of three directions, B linear to 27 numbers without a constant    (2)
    colour  = MLP(feature, sines of it, direction, sines of it), two hidden layers of 128                            (3)
    TV      = mean squared difference of neighbouring cells of M along both axes, doubled, summed over directions    (4)

Sizes, rates, weights and the steps of refinement are those of the authors' configurations. Different here: softplus per
finest cell and linear radiance, as in all models of this folder; the occupied cells (`fields.volume.sampling`) stand
for their alpha mask; and rates fall over the whole training where theirs begin anew at each refinement.
"""

from bisect import bisect_right
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fields.device import Device
from fields.factors import Factors, Grid, geometric_scales
from fields.heads import perceptron
from fields.volume.model import Rates, Setup, VolumeModel, density_of
from fields.volume.paths import Box
from fields.volume.tensor import grid_of

DIRECTIONS = "xyz"
_START = 0.1  # Standard deviation of untrained planes and vectors


@dataclass(frozen=True)
class TensorfSettings:
    """Settings of a TensoRF volume; the defaults are those for outdoor photographs (Tanks and Temples)."""

    # density_channels, colour_channels: R_s and R_c, multiples of 4
    density_channels: int = 16
    colour_channels: int = 48
    # features, hidden, frequencies: Length of (2), width of (3), and octaves of its sines
    features: int = 27
    hidden: int = 128
    frequencies: int = 2
    # n_min, n_max: Cells along the longest edge at first, and after the last refinement
    n_min: int = 128
    n_max: int = 300
    # Shares of the training after which cells become smaller, in geometric steps
    refined_at: tuple[float, ...] = (1 / 15, 1 / 10, 2 / 15, 11 / 60, 7 / 30)
    # tv_density, tv_colour: Weights of (4) at first; they fall as the rates do
    tv_density: float = 0.1
    tv_colour: float = 0.01
    steps: int = 30_000  # Of the training

    @property
    def cells(self) -> list[float]:
        """Cells along the longest edge between the refinements."""
        return geometric_scales(self.n_min, self.n_max, len(self.refined_at) + 1)


class TensorfVolume(VolumeModel):
    """Density and colour of TensoRF; its features are box coordinates, so that colour is looked up where it counts."""

    # Of planes and vectors, and of the networks; to what share rates and `tv_density` fall.
    FACTORS, NETWORKS, FALL = 0.02, 0.001, 0.1

    def __init__(self, box: Box, settings: TensorfSettings, device: Device, *, appearance: int = 0):
        super().__init__(box)
        self.settings, self.device = settings, device
        self._step, self._level = 0, 0
        grid = grid_of(box, settings.cells[0])
        self.density = self._factors(grid, settings.density_channels)
        self.colour = self._factors(grid, settings.colour_channels)
        length = settings.features
        self.basis = nn.Linear(len(DIRECTIONS) * settings.colour_channels, length, bias=False)
        seen = (length + 3) * (1 + 2 * settings.frequencies) + appearance
        self.network = perceptron(seen, settings.hidden, settings.hidden, 3)

    def _factors(self, grid: Grid, channels: int) -> Factors:
        factors = Factors([grid], DIRECTIONS, channels, self.device)
        with torch.no_grad():
            for table in (factors.planes, factors.vectors):
                table.normal_(std=_START)
        return factors

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        u = self.box.unit(x)
        return density_of(self.density(u).sum(dim=1), self.settings.n_max, self.box.edge), u

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        feature = self.basis(self.colour(features))
        seen = [self._with_sines(feature), self._with_sines(-direction)]
        if appearance is not None:
            seen.append(appearance)
        return nn.functional.softplus(self.network(torch.cat(seen, dim=1)), beta=4.0)

    def _with_sines(self, v: Tensor) -> Tensor:
        waves = [wave(2.0**k * v) for k in range(self.settings.frequencies) for wave in (torch.sin, torch.cos)]
        return torch.cat([v, *waves], dim=1)

    def rates(self) -> list[Rates]:
        factors = [*self.density.parameters(), *self.colour.parameters()]
        return [
            Rates(factors, self.FACTORS),
            Rates([*self.basis.parameters(), *self.network.parameters()], self.NETWORKS),
        ]

    def observe(self, losses: list[float]) -> bool:
        self._step = len(losses)
        level = bisect_right(self.settings.refined_at, self._step / self.settings.steps)
        if level <= self._level:  # less where a training goes on for more steps
            return False
        self._refine(level)
        return True

    def penalty(self, x: Tensor) -> Tensor:
        of, decay = self.settings, self.FALL ** (self._step / self.settings.steps)
        density, colour = total_variation(self.density), total_variation(self.colour)
        return decay * (of.tv_density * density + of.tv_colour * colour)

    def _refine(self, level: int) -> None:
        """Cells of a level in place of those of today, interpolated linearly between their middles."""
        grid, self._level = grid_of(self.box, self.settings.cells[level]), level
        self.density, self.colour = (resampled(each, grid) for each in (self.density, self.colour))

    def get_extra_state(self) -> dict:
        return {"step": self._step, "level": self._level}

    def set_extra_state(self, state: dict) -> None:
        self._step = state["step"]

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        # The tables that follow have the sizes of their level.
        level = state_dict[f"{prefix}_extra_state"]["level"]
        if level != self._level:
            self._refine(level)
        super()._load_from_state_dict(state_dict, prefix, *args)


def planes_of(factors: Factors) -> list[Tensor]:
    """Planes (cells along b, along a, channels) of each direction of factors of one scale."""
    return [
        factors.planes[plane : plane + n_a * n_b].view(n_b, n_a, -1)
        for _, _, _, _, n_a, n_b, plane, _ in factors.cells()
    ]


def vectors_of(factors: Factors) -> list[Tensor]:
    """Vectors (cells, channels) of each direction of factors of one scale."""
    return [factors.vectors[vector : vector + n] for _, _, _, n, _, _, _, vector in factors.cells()]


def total_variation(factors: Factors) -> Tensor:
    """Equation (4), times 0.01 as in the authors' code."""
    found = [(plane.diff(dim=0) ** 2).mean() + (plane.diff(dim=1) ** 2).mean() for plane in planes_of(factors)]
    return 0.02 * torch.stack(found).sum()


@torch.no_grad()
def resampled(factors: Factors, grid: Grid) -> Factors:
    """Factors of one scale on other cells, linear between the middles of the old ones."""
    found = Factors([grid], factors.directions, factors.channels, factors.device).to(factors.planes.device)
    for old, new in zip(planes_of(factors), planes_of(found), strict=True):
        new.copy_(_resized(old.permute(2, 0, 1), tuple(new.shape[:2]), "bilinear").permute(1, 2, 0))
    for old, new in zip(vectors_of(factors), vectors_of(found), strict=True):
        new.copy_(_resized(old.T, (len(new),), "linear").T)
    return found


def _resized(table: Tensor, size: tuple[int, ...], mode: str) -> Tensor:
    return nn.functional.interpolate(table[None], size, mode=mode, align_corners=False)[0]


COARSEST = 128 / 300  # Cells at first, of those at last


def tensorf(of: Setup) -> TensorfVolume:
    settings = TensorfSettings(n_min=max(round(COARSEST * of.cells), 2), n_max=of.cells, steps=of.steps)
    return TensorfVolume(of.box, settings, of.device, appearance=of.appearance)
