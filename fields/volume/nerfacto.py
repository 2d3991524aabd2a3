"""Nerfacto (Tancik et al. 2023): features hashed over many resolutions (Instant-NGP, Mueller et al. 2022), two small
perceptrons, and proposals, small densities that select samples (mip-NeRF 360, Barron et al. 2022).

    N_l  = N_min b^l rounded, b = (N_max / N_min)^(1/(L-1)), l = 0..L-1: cells along the longest edge             (1)
    row  = i_x + (n_x + 1) (i_y + (n_y + 1) i_z)    where the (n_x+1)(n_y+1)(n_z+1) nodes of a level fit its table
    row  = (i_x xor 2654435761 i_y xor 805459861 i_z) mod 2^T    elsewhere: nodes share rows                      (2)
    f_l  = the features at the 8 nodes about a sample, weighted linearly along x, y and z                         (3)

Nodes lie at cell corners. Cells are nearly cubes: a flat box has fewer along its height, and more dense levels. The
contraction of space is left out, in place of which is the shell (`fields.volume.shell`), and the refinement of poses:
those of the run are adjusted with bent rays.

Paths are sampled evenly, then where the weights of the first density lie, and so on; the volume is evaluated last. Its
weights w over pieces T teach each histogram (t', w') of the proposal:

    bound(T) = sum of w'_j over the pieces T'_j that overlap T                                    (their eq. 12)
    loss     = sum over i of max(0, w_i - bound(T_i))^2 / w_i                                     (their eq. 13)

so that a proposal may be wider than the volume's own histogram, never lower. At first samples are drawn by weights to
the power b t / ((b - 1) t + 1), b = 10, t the share of the annealing that is done (their eq. 18); by the weights
themselves outside of the training, where no gradient is taken.
"""

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from fields.factors import geometric_scales
from fields.heads import conditions_of, perceptron
from fields.volume.model import Rates, Setup, VolumeModel, density_of
from fields.volume.paths import Box, Paths
from fields.volume.sampling import Samples, render_weights, samples_by_mass
from fields.volume.tensor import grid_of

PRIMES = (1, 2654435761, 805459861)
PER_LEVEL = 2


class HashGrid(nn.Module):
    """Features (2 a level) of positions in a box, drawn from torch's generator.

    ``levels``, ``log2_table``: L and T. ``n_min``, ``n_max``: cells along the longest edge at the coarsest and the
    finest level.
    """

    cells: Tensor
    strides: Tensor
    first: Tensor

    def __init__(self, box: Box, levels: int, log2_table: int, n_min: int, n_max: int):
        super().__init__()
        grids = [grid_of(box, round(n)) for n in geometric_scales(n_min, n_max, levels)]
        cells = torch.tensor([(g.nx, g.ny, g.nz) for g in grids]).T
        nodes = (cells + 1).prod(dim=0)
        self.num_dense = int((nodes <= 2**log2_table).sum())
        self.mask = 2**log2_table - 1
        strides = torch.tensor(PRIMES)[:, None].repeat(1, levels)
        nx, ny, _ = cells[:, : self.num_dense] + 1
        strides[:, : self.num_dense] = torch.stack([torch.ones_like(nx), nx, nx * ny])
        rows = nodes.clamp(max=2**log2_table)
        self.register_buffer("cells", cells, persistent=False)
        self.register_buffer("strides", strides, persistent=False)
        self.register_buffer("first", torch.cumsum(rows, 0) - rows, persistent=False)
        self.table = nn.Parameter(torch.empty(int(rows.sum()), PER_LEVEL).uniform_(-1e-4, 1e-4))

    def rows(self, corner: Tensor) -> Tensor:
        """Equation (2): rows (8, L, S) int32 of the nodes about cells whose lowest nodes are ``corner`` (3, L, S).

        Rows of a level count from its first. Of each product only the last T bits count, in sums too: those fit.
        """
        nodes = torch.stack([corner, corner + 1], dim=1) * self.strides[:, None, :, None] & self.mask
        x, y, z = nodes.int()
        x, y, z = x[:, None, None], y[None, :, None], z[None, None, :]
        d = self.num_dense
        dense = x[..., :d, :] + y[..., :d, :] + z[..., :d, :]
        hashed = x[..., d:, :] ^ y[..., d:, :] ^ z[..., d:, :]
        return torch.cat([dense, hashed], dim=-2).flatten(0, 2)

    def forward(self, u: Tensor) -> Tensor:
        """Features (S, L * 2) at box coordinates u (S, 3) in [0, 1]; outside, those of the border.

        No gradient flows to `u`. That of the table is summed in one order on any number of threads.
        """
        x = u.detach().clamp(0.0, 1.0).T[:, None] * self.cells[..., None]
        corner = torch.minimum(x.long(), self.cells[..., None] - 1)
        share = x - corner
        wx, wy, wz = torch.stack([1.0 - share, share], dim=1)
        weights = (wx[:, None, None] * wy[None, :, None] * wz[None, None, :]).flatten(0, 2)
        rows = self.rows(corner) + self.first.int()[:, None]
        # A pair of features travels as one complex number: the table is passed once, and its gradient is a plain loop.
        pairs = torch.view_as_complex(self.table).index_select(0, rows.view(-1)).view(weights.shape)
        features = (torch.view_as_real(pairs) * weights[..., None]).sum(dim=0)
        return features.transpose(0, 1).flatten(1)


# Share of the samples spread evenly whatever the weights, so that space a proposal calls empty is still sampled.
EVEN_SHARE = 0.1
SLOPE = 10.0  # b of the annealing


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
        conditions = conditions_of(-direction, self.settings.degree, appearance)
        return nn.functional.softplus(self.colour(torch.cat([features, *conditions], dim=1)), beta=4.0)

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
