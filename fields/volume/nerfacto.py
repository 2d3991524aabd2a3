"""A hash grid with the heads, sizes and proposals of Nerfacto (Tancik et al. 2023).

Left out are the contraction of space, in place of which is the shell (`fields.volume.shell`), and the refinement of
poses: those of the run are adjusted with bent rays.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from fields.heads import perceptron, seen_radiance
from fields.training import Rates
from fields.volume.hash_grid import PER_LEVEL, HashGrid
from fields.volume.model import Setup, VolumeModel, density_of
from fields.volume.paths import Box
from fields.volume.proposal import Proposal, ProposalSettings


@dataclass(frozen=True)
class HashSettings:
    """Settings of a hash grid volume; the defaults are Nerfacto's."""

    # levels, log2_table: L and T
    levels: int = 16
    log2_table: int = 19
    # n_min, n_max: Cells along the longest edge at the coarsest and the finest level
    n_min: int = 16
    n_max: int = 2048
    # hidden, geometry: Width of both heads, and length of the features that density hands on to colour
    hidden: int = 64
    geometry: int = 15
    degree: int = 3  # Of the spherical harmonics of the direction, at most 3; 0 for a matt scene
    # proposed, coarser: samples of each round of proposals, and by how much its cells are longer than asked for
    proposed: tuple[int, ...] = ProposalSettings.samples
    coarser: tuple[int, ...] = (2, 1)
    annealed: float = 1 / 30  # Share of the steps over which proposals anneal: 1000 of 30,000 as published


class HashVolume(VolumeModel):
    """A hash grid and two small perceptrons: density, and colour seen along a direction.

    Density is ``softplus`` per finest cell (Nerfacto has a truncated exponential, which softplus follows where the
    box is thin); an untrained box lets about 1/e of the light through along its longest edge.
    """

    RATE = 0.01

    def __init__(self, box: Box, settings: HashSettings, *, appearance: int = 0):
        super().__init__(box)
        self.settings = settings
        hidden, geometry = settings.hidden, settings.geometry
        self.grid = HashGrid(box, settings.levels, settings.log2_table, settings.n_min, settings.n_max)
        self.density = perceptron(PER_LEVEL * settings.levels, hidden, 1 + geometry)
        seen = geometry + (settings.degree + 1) ** 2 - 1 + appearance
        self.colour = perceptron(seen, hidden, hidden, 3)

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        out = self.density(self.grid(self.box.unit(x)))
        return density_of(out[:, 0], self.settings.n_max, self.box.edge), out[:, 1:]

    def proposal(self, setup: Setup) -> Proposal:
        of = self.settings
        rounds = tuple(max(setup.cells // divisor, 2) for divisor in of.coarser)
        annealed = round(of.annealed * setup.steps)
        return Proposal(self.box, ProposalSettings(of.proposed, rounds, annealed=annealed))

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        return seen_radiance(self.colour, features, direction, self.settings.degree, appearance)

    def rates(self) -> list[Rates]:
        return [Rates(list(self.parameters()), self.RATE)]


def nerfacto(of: Setup) -> HashVolume:
    """The model of a setup, at its published size."""
    return HashVolume(of.box, HashSettings(n_max=4 * of.cells), appearance=of.appearance)


def hash_grid(of: Setup) -> HashVolume:
    """The model of a setup at a size for processors, with one round of proposals."""
    small = HashSettings(
        levels=8, log2_table=15, n_max=4 * of.cells, degree=2, proposed=(48,), coarser=(1,), annealed=0.0
    )
    return HashVolume(of.box, small, appearance=of.appearance)
