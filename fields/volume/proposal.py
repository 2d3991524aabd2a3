"""Proposal network: a small density that selects samples (mip-NeRF 360, Barron et al. 2022; Nerfacto).

Paths are sampled evenly, then where the weights of the first density lie, and so on; the volume is evaluated last. Its
weights w over pieces T teach each histogram (t', w') of the proposal:

    bound(T) = sum of w'_j over the pieces T'_j that overlap T                                    (their eq. 12)
    loss     = sum over i of max(0, w_i - bound(T_i))^2 / w_i                                     (their eq. 13)

so that a proposal may be wider than the volume's own histogram, never lower. At first samples are drawn by weights to
the power b t / ((b - 1) t + 1), b = 10, t the share of the annealing that is done (their eq. 18); by the weights
themselves outside of the training, where no gradient is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fields.compositing import render_weights
from fields.training import Rates
from fields.volume.hash_grid import PER_LEVEL, HashGrid
from fields.volume.model import density_of
from fields.volume.paths import Box, Paths
from fields.volume.sampling import Samples, samples_by_mass

# Share of the samples spread evenly whatever the weights, so that space a proposal calls empty is still sampled.
EVEN_SHARE = 0.1
# b of the annealing.
SLOPE = 10.0


@dataclass(frozen=True)
class ProposalSettings:
    """Settings of a proposal; the defaults are Nerfacto's."""

    samples: tuple[int, ...] = (256, 96)  # Of each path, round by round
    n_max: tuple[int, ...] = (128, 256)  # Cells along the longest edge at the finest level, round by round
    # n_min, levels, log2_table: Of the hash grids, as in `HashSettings`
    n_min: int = 16
    levels: int = 5
    log2_table: int = 17
    hidden: int = 16  # Width of the perceptrons
    annealed: int = 0  # Steps of the annealing (Nerfacto: 1000 of 30,000)

    def __post_init__(self):
        if not self.samples or len(self.samples) != len(self.n_max):
            raise ValueError(f"samples {self.samples} and n_max {self.n_max} expect one number for each round")


@dataclass
class Histogram:
    """Weights (N, B) of the pieces of paths between edges (N, B + 1) [m]."""

    edges: Tensor
    weights: Tensor


@dataclass
class Proposed(Samples):
    """Samples with the histograms that led to them."""

    rounds: list[Histogram]


class Proposal(nn.Module):
    """Densities that draw samples, coarse first; a share of the samples is always even."""

    RATE = 0.01

    step: Tensor

    def __init__(self, box: Box, settings: ProposalSettings):
        super().__init__()
        self.box, self.settings = box, settings
        self.register_buffer("step", torch.zeros((), dtype=torch.int64))
        grids = [HashGrid(box, settings.levels, settings.log2_table, settings.n_min, n) for n in settings.n_max]
        width, hidden = PER_LEVEL * settings.levels, settings.hidden
        self.rounds = nn.ModuleList(
            nn.Sequential(grid, nn.Linear(width, hidden), nn.ReLU(), nn.Linear(hidden, 1)) for grid in grids
        )

    def density(self, index: int, x: Tensor) -> Tensor:
        """Density (S,) [1/m] of one round at positions (S, 3) [m], local."""
        return density_of(self.rounds[index](self.box.unit(x))[:, 0], self.settings.n_max[index], self.box.edge)

    def samples(self, paths: Paths, num: int, *, jitter: bool) -> Proposed:
        """``num`` samples a path where the densities put weight; they carry no gradient, their histograms do."""
        edges, mass, rounds = torch.stack([paths.near, paths.far], dim=1), paths.near.new_ones(len(paths), 1), []
        for index, count in enumerate(self.settings.samples):
            drawn = samples_by_mass(edges, mass, count, jitter, dense=True)
            density = self.density(index, paths.at(drawn.s).view(-1, 3)).view(len(paths), count)
            rounds.append(Histogram(drawn.edges, render_weights(density * drawn.length)))
            power = self.power() if torch.is_grad_enabled() else 1.0
            even = drawn.length / drawn.length.sum(dim=1, keepdim=True).clamp(min=1e-12)
            mass = (1.0 - EVEN_SHARE) * rounds[-1].weights.detach() ** power + EVEN_SHARE * even
            edges = drawn.edges
        drawn = samples_by_mass(edges, mass, num, jitter, dense=True)
        return Proposed(drawn.s, drawn.length, drawn.edges, rounds)

    def power(self) -> float:
        """Power of the weights that draw samples in training; 1 once the annealing is over."""
        if int(self.step) >= self.settings.annealed:
            return 1.0
        done = int(self.step) / self.settings.annealed
        return SLOPE * done / ((SLOPE - 1.0) * done + 1.0)

    def loss(self, samples: Proposed, weights: Tensor) -> Tensor:
        """Sum of all rounds' interlevel losses, a scalar, for a volume's weights (N, K) at the samples of a step."""
        self.step += 1
        own = Histogram(samples.edges, weights.detach())
        return torch.stack([interlevel_loss(own, proposed) for proposed in samples.rounds]).sum()

    def rates(self) -> list[Rates]:
        """Every parameter once, with its learning rate."""
        return [Rates(list(self.parameters()), self.RATE)]


def interlevel_loss(own: Histogram, proposed: Histogram) -> Tensor:
    """Equation 13, mean over paths: how far a volume's own histogram exceeds the bound from the proposal."""
    excess = (own.weights - bound_of(proposed, own.edges)).clamp(min=0.0)
    # The excess is at most the weight itself: a weight of zero gives 0, not 0 / 0.
    return (excess**2 / own.weights.clamp(min=1e-7)).sum(dim=1).mean()


def bound_of(proposed: Histogram, edges: Tensor) -> Tensor:
    """Equation 12: weight (N, K) of the proposed pieces that overlap those between edges (N, K + 1) [m]."""
    total = torch.nn.functional.pad(torch.cumsum(proposed.weights, dim=1), (1, 0))
    last = proposed.weights.shape[1]
    bins, start, end = (t.contiguous() for t in (proposed.edges, edges[:, :-1], edges[:, 1:]))
    begins = (torch.searchsorted(bins, start, right=True) - 1).clamp(0, last)
    ends = torch.searchsorted(bins, end).clamp(0, last)
    return total.gather(1, torch.maximum(begins, ends)) - total.gather(1, begins)
