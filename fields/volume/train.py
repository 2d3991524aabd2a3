"""Training of a volume from photographs: paths drawn, sampled in the proxy, rendered, and compared."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch

from fields.threads import half_the_threads
from fields.training import adam, descend, psnr_db, set_rates
from fields.volume.density_loss import NodeScores
from fields.volume.losses import Losses
from fields.volume.paths import Box, Paths
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells

# Paths are drawn for this many steps at once.
POOL_STEPS = 32
# Number of last steps over which the reported error is taken.
LAST_STEPS = 100
ADAM_EPS = 1e-15
# Cells of the proxy whose density is evaluated at once.
CHUNK = 1 << 18


@dataclass(frozen=True)
class Training:
    """How a volume is trained.

    Attributes
    ----------
    steps, rays : int
        Steps, and paths of each.
    samples : int
        Of each path.
    cells : int
        Of the proxy, along the longest edge of the box.
    refresh : tuple of float
        Shares of the steps after which the proxy is taken from the field itself.
    margin : float
        s of the paper, in cells of the proxy.
    final_rate : float
        Learning rates fall to this share of their start, exponentially.
    by_score : float
        Share of the samples drawn where density has detail (`fields.volume.density_loss.NodeScores`).
    losses : Losses
        What is added to the squared error of the colours.
    losses_from : float
        Share of the steps after which they count: a loss that draws weights together does harm while these are wrong.
    """

    steps: int = 2000
    rays: int = 4096
    samples: int = 48
    cells: int = 96
    refresh: tuple[float, ...] = (0.1, 0.2, 0.35, 0.6)
    margin: float = 1.5
    final_rate: float = 0.1
    by_score: float = 0.0
    losses: Losses = field(default_factory=Losses)
    losses_from: float = 0.0


@dataclass(frozen=True)
class VolumeFigures:
    """Figures reported about the training of a volume.

    Attributes
    ----------
    steps : int
    changed_at : tuple of int
        Steps at which the model changed its parameters or their rates.
    psnr_db : float
        Of the photographs, over the last steps.
    parameters : int
    """

    steps: int
    changed_at: tuple[int, ...]
    psnr_db: float
    parameters: int


@half_the_threads()
def train_volume(
    renderer: VolumeRenderer,
    photographs: Photographs,
    training: Training,
    progress: Callable[[float], None],
    *,
    cells: Cells | None = None,
    seed: int = 0,
) -> tuple[Cells, VolumeFigures]:
    """Fit a volume and its surroundings to photographs.

    Parameters
    ----------
    cells : Cells or None
        Where surfaces may be at first (of the sweep, or of points of structure from motion); None: anywhere in the box.

    Returns
    -------
    cells : Cells
        The proxy, taken from the field itself.
    figures : VolumeFigures
    """
    if renderer.proposal is not None and training.by_score:
        raise ValueError(f"by_score is {training.by_score}, but the volume's proposal draws samples: use one of both")
    torch.manual_seed(seed)
    box = renderer.model.box
    cells = cells if cells is not None else Cells.everywhere(box, training.cells)
    scores = NodeScores(box, box.edge / training.cells) if training.by_score else None
    refresh = {round(share * training.steps) for share in training.refresh}
    optimiser, losses, changed = adam(renderer.rates(), eps=ADAM_EPS), [], []
    for step, paths in enumerate(_batches(photographs, box, training, seed)):
        if step in refresh:
            cells = proxy_of(renderer, cells, training.margin * box.edge / max(cells.occupied.shape))
        set_rates(optimiser, training.final_rate ** (step / training.steps))
        if scores is None:
            samples = renderer.samples(paths, cells, training.samples, jitter=True)
        else:
            scores.update(renderer.model)
            samples = scores.samples(cells, paths, training.samples, training.by_score)
        rendered = renderer.render(paths, samples)
        error = ((rendered.rgb - paths.rgb) ** 2).mean()
        total = error + renderer.penalty(paths, rendered)
        if step >= training.losses_from * training.steps:
            total = total + training.losses(renderer, paths, rendered, cells, photographs.water)
        descend(optimiser, total)
        losses.append(float(error.detach()))
        if renderer.model.observe(losses):
            changed.append(step)
            optimiser = adam(renderer.rates(), eps=ADAM_EPS)
        progress((step + 1) / training.steps)
    parameters = sum(p.numel() for p in renderer.parameters())
    return cells, VolumeFigures(training.steps, tuple(changed), psnr_db(losses[-LAST_STEPS:]), parameters)


@torch.no_grad()
def proxy_of(renderer: VolumeRenderer, cells: Cells, margin: float) -> Cells:
    """The cells of a proxy in which the volume itself stops light, and those within ``margin`` [m] of them.

    A cell counts if it takes a tenth of the light that crosses it: ten times what fog would that fills the box.
    """
    thick = torch.cat([renderer.model.evaluate(part)[0] for part in cells.centres().split(CHUNK)])
    cell = cells.box.edge / max(cells.occupied.shape)
    return cells.refined(1.0 - torch.exp(-thick * cell), 0.1, margin)


def _batches(photographs: Photographs, box: Box, training: Training, seed: int) -> Iterator[Paths]:
    """Paths of each step: as many whole patches as its rays hold, one at least."""
    rng, patch = np.random.default_rng(seed), training.losses.patch
    patches = max(training.rays // patch**2, 1)
    for first in range(0, training.steps, POOL_STEPS):
        count = min(POOL_STEPS, training.steps - first)
        pool = photographs.draw(count * patches, box, rng, patch)
        for part in torch.arange(len(pool)).split(patches * patch**2):
            yield pool[part]
