"""Octree of fields: level of detail by nodes that each have a grid of their own (Inf-NeRF, Liang et al. 2024).

    g_l    = edge / (N 2^l): cell of a node of level l, whose edges are those of the box over 2^l                  (1)
    node of a sample = the deepest node about it with g_parent > footprint: it goes down while cells are coarser   (2)
    f      = the features at the 8 nodes of its cells about a sample, weighted linearly                            (3)
    L_reg  = mean (exp(-a_parent) - mean of exp(-a_child) at x and g_child to each side)^2, a = density g_parent    (4)
    score  = decay score + (1 - decay) (|mean g grad a| + var a), a the opacity of a piece of length g             (5)

(4) keeps a parent what its children are when they are blurred, so that levels may be left out; Inf-NeRF's code has the
density in the unit of its scene for a. Axes of fewer than three cells, as those of a flat box, have no cell with a
neighbour to each side: (4) leaves them out. It builds its tree from tie points before training; here the tree grows
where density has detail: leaves whose score (5) is at least the mean of all leaves are split, `refined_at` shares of
the training, and children begin as their parent, exactly: their cells halve its own. Different here: dense grids in
place of hashed ones, and one pair of heads for all nodes; the footprint is the same for all samples of a step, drawn
among the levels in training, since photographs of a survey have one scale (Inf-NeRF takes that of each pixel, and
trains on pictures of several sizes).
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fields.heads import conditions_of, perceptron
from fields.volume.model import Rates, Setup, VolumeModel, density_of
from fields.volume.paths import Box

# Leaves looked at for (5) in a step, points in each node, and pairs of parent and child for (4).
SCORED, POINTS, PAIRS = 16, 32, 4


@dataclass(frozen=True)
class OctreeSettings:
    cells: int = 16  # N: of a node, along its longest edge
    depth: int = 3  # Levels at most
    features: int = 8
    hidden: int = 32  # Of the colour head
    degree: int = 2  # Of the harmonics of the direction; 0 for a matt scene
    refined_at: tuple[float, ...] = (0.15, 0.35)  # Shares of the steps after which leaves are split
    decay: float = 0.8  # Of the scores
    consistency: float = 0.01  # Weight of (4), that of Inf-NeRF's code
    coarse: float = 0.25  # Share of the training steps that see a coarser level than the finest
    steps: int = 2000  # Of the training


class OctreeVolume(VolumeModel):
    """Density and colour by the grids of an octree's nodes."""

    GRIDS, HEADS = 0.02, 0.001

    child: Tensor  # (nodes, 8) int64: number of each child, -1 where there is none; bits are z, y, x
    low: Tensor  # (nodes, 3) in box coordinates
    level: Tensor  # (nodes,) int64
    score: Tensor  # (nodes,)

    def __init__(self, box: Box, settings: OctreeSettings, *, appearance: int = 0):
        super().__init__(box)
        self.settings, self._step = settings, 0
        self.counts = box.counts(settings.cells)
        self.register_buffer("child", torch.full((1, 8), -1))
        self.register_buffer("low", torch.zeros(1, 3))
        self.register_buffer("level", torch.zeros(1, dtype=torch.int64))
        self.register_buffer("score", torch.zeros(1))
        self.table = nn.Parameter(0.1 * torch.randn(1, self._rows, settings.features))
        self.density = nn.Linear(settings.features, 1, bias=False)
        nn.init.constant_(self.density.weight, 1.0)
        seen = settings.features + (settings.degree + 1) ** 2 - 1 + appearance
        self.colour = perceptron(seen, settings.hidden, settings.hidden, 3)

    @property
    def _rows(self) -> int:
        return int(np.prod([n + 1 for n in self.counts]))

    def cell(self, level: int) -> float:
        """g of a level [m]."""
        return self.box.edge / (self.settings.cells * 2.0**level)

    def node_of(self, u: Tensor, footprint: float) -> Tensor:
        """Node (S,) of box coordinates (S, 3) for a footprint [m], equation (2)."""
        node = torch.zeros(len(u), dtype=torch.int64, device=u.device)
        u = u.clamp(0.0, 1.0 - 1e-6)
        for level in range(1, self.settings.depth):
            if self.cell(level - 1) <= footprint:
                break
            x, y, z = (torch.floor(u * 2.0**level).long() % 2).T
            below = self.child[node, x + 2 * y + 4 * z]
            node = torch.where(below >= 0, below, node)
        return node

    def features(self, u: Tensor, node: Tensor) -> Tensor:
        """Features (S, F) of nodes (S,) at box coordinates (S, 3), equation (3)."""
        counts = torch.tensor(self.counts, device=u.device)
        scale = 2.0 ** self.level[node].to(u.dtype)
        x = ((u.detach() - self.low[node].to(u.dtype)) * scale[:, None]).clamp(0.0, 1.0) * counts
        corner = torch.minimum(x.long(), counts - 1)
        share = x - corner
        nx, ny, _ = (n + 1 for n in self.counts)
        first = node * self._rows + corner[:, 0] + nx * (corner[:, 1] + ny * corner[:, 2])
        rows, weights = [], []
        for k in range(8):
            bits = [(k >> axis) & 1 for axis in range(3)]
            rows.append(first + bits[0] + nx * (bits[1] + ny * bits[2]))
            sides = [share[:, axis] if bits[axis] else 1.0 - share[:, axis] for axis in range(3)]
            weights.append(sides[0] * sides[1] * sides[2])
        flat = self.table.view(-1, self.table.shape[2])
        found = flat[torch.cat(rows)].view(8, len(u), -1)
        return (found * torch.stack(weights)[..., None].to(found.dtype)).sum(dim=0)

    def _density(self, features: Tensor) -> Tensor:
        finest = self.settings.cells * 2.0 ** (self.settings.depth - 1)
        return density_of(self.density(features)[:, 0], finest, self.box.edge)

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return self._at(x, 0.0)

    def thickness(self, x: Tensor, direction: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        density, features = self._at(x, self._drawn() if torch.is_grad_enabled() else 0.0)
        return density * length, features

    def _at(self, x: Tensor, footprint: float) -> tuple[Tensor, Tensor]:
        u = self.box.unit(x)
        features = self.features(u, self.node_of(u, footprint))
        return self._density(features), features

    def _drawn(self) -> float:
        """The footprint of a step of the training [m]."""
        deepest = int(self.level.max())
        if not deepest or float(torch.rand(())) >= self.settings.coarse:
            return 0.0
        return self.cell(int(torch.randint(deepest, ())))

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        conditions = conditions_of(-direction, self.settings.degree, appearance)
        return nn.functional.softplus(self.colour(torch.cat([features, *conditions], dim=1)), beta=4.0)

    def penalty(self, x: Tensor) -> Tensor:
        """Equation (4) of some pairs, times its weight."""
        parents = (self.child >= 0).nonzero()
        if not self.settings.consistency or not len(parents):
            return x.new_zeros(())
        drawn = parents[torch.randint(len(parents), (PAIRS,), device=parents.device)]
        return self.settings.consistency * self.inconsistency(drawn[:, 0], self.child[drawn[:, 0], drawn[:, 1]])

    def inconsistency(self, parent: Tensor, child: Tensor) -> Tensor:
        """Equation (4) of parents (P,) and their children (P,), at points drawn a cell inside the children."""
        counts = torch.tensor(self.counts, device=self.place)
        cell, inner = 1.0 / counts, counts >= 3
        axes = (torch.eye(3, device=self.place) * cell)[inner]
        u, fine = self._drawn_in(child, 1, torch.where(inner, cell, 0.0), axes)
        length = (self.box.edge / self.settings.cells) * 2.0 ** -self.level[parent].to(torch.float32)[:, None]
        coarse = self._density(self.features(u.reshape(-1, 3), parent.repeat_interleave(POINTS))).view(-1, POINTS)
        kept = torch.exp(-fine * length[..., None]).mean(dim=2)
        return ((kept - torch.exp(-coarse * length)) ** 2).mean()

    def _drawn_in(self, node: Tensor, different: int, margin: Tensor, axes: Tensor) -> tuple[Tensor, Tensor]:
        """Points (P, `POINTS`, 3) drawn a margin inside nodes (P,), and densities there and at offsets by +-axes.

        The offsets and the margin are shares of a node, in which the points are the same unless P are ``different``.
        """
        share = margin + (1.0 - 2.0 * margin) * torch.rand(different, POINTS, 3, device=self.place)
        edge = 2.0 ** -self.level[node].to(torch.float32)[:, None, None]
        u, offsets = self.low[node][:, None] + edge * share, torch.cat([torch.zeros_like(axes[:1]), axes, -axes])
        near = (u[:, :, None] + edge[..., None] * offsets).reshape(-1, 3)
        density = self._density(self.features(near, node.repeat_interleave(POINTS * len(offsets))))
        return u, density.view(len(node), POINTS, -1)

    def observe(self, losses: list[float]) -> bool:
        of, self._step = self.settings, len(losses)
        self._look()
        if self._step not in {round(share * of.steps) for share in of.refined_at}:
            return False
        leaves = self.leaves()
        score = self.score[leaves]
        chosen = leaves[(score > 0.0) & (score >= score.mean())]
        if not len(chosen):
            return False
        self.split(chosen)
        return True

    def leaves(self) -> Tensor:
        """Numbers of the nodes that may be split."""
        childless = (self.child < 0).all(dim=1) & (self.level < self.settings.depth - 1)
        return childless.nonzero()[:, 0]

    @torch.no_grad()
    def _look(self) -> None:
        """Score some leaves by equation (5)."""
        leaves = self.leaves()
        if not len(leaves):
            return
        node = leaves[torch.randperm(len(leaves), device=leaves.device)[:SCORED]]
        counts = torch.tensor(self.counts, device=self.place)
        # Along axes of one or two cells half a cell to each side of a point has to lie in the node.
        margin = torch.where(counts < 3, 0.5 / counts, 0.0)
        _, density = self._drawn_in(node, len(node), margin, 0.5 * torch.eye(3, device=self.place) / counts)
        length = (self.box.edge / self.settings.cells) * 2.0 ** -self.level[node].to(torch.float32)
        a = -torch.expm1(-density * length[:, None, None])
        gradient = (a[..., 1:4] - a[..., 4:]).mean(dim=1).norm(dim=1)
        fresh = gradient + a[..., 0].var(dim=1, correction=0)
        self.score[node] = self.settings.decay * self.score[node] + (1.0 - self.settings.decay) * fresh

    @torch.no_grad()
    def split(self, nodes: Tensor) -> None:
        """Split nodes (P,) into children with the values of their parents."""
        first, place = len(self.child), self.place
        number = first + torch.arange(8 * len(nodes), device=place).view(-1, 8)
        level = self.level[nodes].repeat_interleave(8) + 1
        octant = torch.tensor([[(k >> axis) & 1 for axis in range(3)] for k in range(8)], device=place)
        edge = 2.0 ** -level.to(torch.float32)[:, None]
        low = self.low[nodes].repeat_interleave(8, dim=0) + edge * octant.repeat(len(nodes), 1)
        axes = [torch.linspace(0.0, 1.0, n + 1, device=place) for n in self.counts]
        z, y, x = torch.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
        grid = torch.stack([x, y, z], dim=-1).view(-1, 3)
        parent = nodes.repeat_interleave(8)
        u = (low[:, None] + edge[:, None] * grid).reshape(-1, 3)
        rows = self.features(u, parent.repeat_interleave(self._rows)).view(len(parent), self._rows, -1)
        self.child[nodes] = number
        self.child = torch.cat([self.child, torch.full((len(parent), 8), -1, device=place)])
        self.low, self.level = torch.cat([self.low, low]), torch.cat([self.level, level])
        self.score = torch.cat([self.score, self.score[parent]])
        self.table = nn.Parameter(torch.cat([self.table, rows]))

    def rates(self) -> list[Rates]:
        heads = [*self.density.parameters(), *self.colour.parameters()]
        return [Rates([self.table], self.GRIDS), Rates(heads, self.HEADS)]

    def get_extra_state(self) -> dict:
        return {"step": self._step}

    def set_extra_state(self, state: dict) -> None:
        self._step = state["step"]

    def _load_from_state_dict(self, state_dict, prefix, *args) -> None:
        # A tree that has grown has more nodes than an untrained one.
        for name in ("child", "low", "level", "score"):
            setattr(self, name, torch.empty_like(state_dict[f"{prefix}{name}"], device=self.place))
        self.table = nn.Parameter(torch.empty_like(state_dict[f"{prefix}table"], device=self.place))
        super()._load_from_state_dict(state_dict, prefix, *args)


def octree(of: Setup) -> OctreeVolume:
    settings = OctreeSettings(cells=max(of.cells // 4, 2), steps=of.steps)
    return OctreeVolume(of.box, settings, appearance=of.appearance)
