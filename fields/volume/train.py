"""Training of a volume from photographs: paths drawn, sampled in the proxy, rendered, and compared."""

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import torch

from fields.device import half_the_threads
from fields.models import Losses
from fields.volume.losses import added_loss
from fields.volume.model import Rates, VolumeModel
from fields.volume.paths import Paths
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from refract import WaterSurface

POOL_STEPS = 32  # Paths are drawn for this many steps at once
LAST_STEPS = 100  # Number of last steps over which the reported error is taken, at most
# Moments of a training at which its error is reported, and paths of photographs held out that are predicted then.
MOMENTS, HELD_PATHS = 25, 4096
ADAM_EPS = 1e-15
CHUNK = 1 << 18  # Cells of the proxy whose density is evaluated at once


@dataclass(frozen=True)
class Training:
    # steps, rays: Steps, and paths of each
    steps: int = 2000
    rays: int = 4096
    samples: int = 48  # Of each path
    cells: int = 96  # Of the proxy, along the longest edge of the box
    # Shares of the steps after which the proxy is taken from the field itself
    refresh: tuple[float, ...] = (0.1, 0.2, 0.35, 0.6)
    margin: float = 1.5  # s of the paper, in cells of the proxy
    final_rate: float = 0.1  # Learning rates fall to this share of their start, exponentially
    falls_from: float = 0.0  # Share of the steps after which they do
    losses: Losses = field(default_factory=Losses)  # What is added to the error of the colours


@dataclass(frozen=True)
class VolumeFigures:
    """Figures reported about the training of a volume."""

    steps: int
    changed_at: tuple[int, ...]  # Steps at which the model changed its parameters or their rates
    psnr_db: float  # Of the photographs, over the last steps
    parameters: int
    # Steps done, PSNR [dB] of the photographs since the moment before, and of those held out where there are some
    history: list[tuple[int, float, float | None]]
    cpu_s: float = field(compare=False)  # Processor time of all steps, also of those before an interruption


class OtherState(ValueError):
    """The state of a checkpoint is not one of the renderer that is trained."""


class Checkpoints(Protocol):
    """Checkpoints of a training, from which an interrupted one continues."""

    def load(self) -> dict[str, Any] | None:
        """The state that was saved last; None where there is none."""

    def save(self, make: Callable[[], dict[str, Any]], *, last: bool) -> None:
        """Save the state that ``make`` gives, or pass over it: called before every step, and after the last."""


@half_the_threads()
def train_volume(
    renderer: VolumeRenderer,
    photographs: Photographs,
    training: Training,
    progress: Callable[[float, list[float]], None],
    *,
    cells: Cells | None = None,
    seed: int = 0,
    checkpoints: Checkpoints | None = None,
    held: Photographs | None = None,
) -> tuple[Cells, VolumeFigures]:
    """Fit a volume and its surroundings to photographs.

    ``progress``: called after each step with the share done and the errors of all steps. ``cells``: where surfaces may
    be at first (of the sweep, or of points of structure from motion); None: anywhere in the box. ``checkpoints``: a
    training that goes on from one computes what it would have computed without the interruption. ``held``: photographs
    held out, whose prediction is followed. Returns ``cells`` Cells: the proxy, taken from the field itself; ``figures``
    VolumeFigures. Raises OtherState where a checkpoint is of another field.
    """
    torch.manual_seed(seed)
    box = renderer.model.box
    cells = cells if cells is not None else Cells.everywhere(box, training.cells)
    state = _State(0, cells.to(renderer.model.place), adam(renderer.rates(), eps=ADAM_EPS))
    if checkpoints is not None and (saved := checkpoints.load()) is not None:
        state.restore(saved, renderer)
    refresh = {round(share * training.steps) for share in training.refresh}
    moments = {max(round(training.steps * moment / MOMENTS), 1) for moment in range(1, MOMENTS + 1)}
    followed = None
    # With vectors of appearance each photograph would need its own.
    if held is not None and renderer.appearance is None and any(len(pixels) for pixels in held.pixels):
        followed = held.draw(HELD_PATHS, box, np.random.default_rng(0)).to(renderer.model.place)
    for paths in _batches(photographs, renderer.model, training, seed, state.step):
        if checkpoints is not None:
            checkpoints.save(lambda: state.saved(renderer), last=False)
        if state.step in refresh:
            state.cells = proxy_of(renderer, state.cells, training.margin * state.cells.edge)
        _step(renderer, paths, training, state, photographs.water)
        if state.step in moments:
            since = state.history[-1][0] if state.history else 0
            held_db = None
            if followed is not None:
                with torch.no_grad():
                    samples = renderer.samples(followed, state.cells, training.samples, jitter=False)
                    held_db = psnr_db([float(((renderer.render(followed, samples).rgb - followed.rgb) ** 2).mean())])
            state.history.append((state.step, psnr_db(state.losses[since:]), held_db))
        progress(state.step / training.steps, state.losses)
    if checkpoints is not None:
        checkpoints.save(lambda: state.saved(renderer), last=True)
    parameters = sum(p.numel() for p in renderer.parameters())
    # Of a short training the last tenth: its first steps know nothing.
    of_last = psnr_db(state.losses[-max(min(LAST_STEPS, training.steps // 10), 1) :])
    cpu_s, changed = time.process_time() - state.since_s, tuple(state.changed)
    return state.cells, VolumeFigures(training.steps, changed, of_last, parameters, state.history, cpu_s)


@dataclass
class _State:
    """A training before its next step."""

    step: int
    cells: Cells
    optimiser: torch.optim.Adam
    losses: list[float] = field(default_factory=list)
    changed: list[int] = field(default_factory=list)
    history: list[tuple[int, float, float | None]] = field(default_factory=list)
    since_s: float = field(default_factory=time.process_time)  # Processor time at which the steps would have begun here

    def saved(self, renderer: VolumeRenderer) -> dict[str, Any]:
        """State that the next steps depend on, for `torch.save`; the pixels that they draw follow from the step."""
        generators = {"cpu": torch.get_rng_state()}
        if torch.cuda.is_available():
            generators["cuda"] = torch.cuda.get_rng_state()
        return {
            "step": self.step,
            "renderer": renderer.state_dict(),
            "occupied": self.cells.occupied,
            "optimiser": self.optimiser.state_dict(),
            "losses": torch.tensor(self.losses, dtype=torch.float64),
            "changed": self.changed,
            "history": self.history,
            "cpu_s": time.process_time() - self.since_s,
            "generator": generators,
        }

    def restore(self, saved: dict[str, Any], renderer: VolumeRenderer) -> None:
        """Go back to a state that was saved; raises OtherState where it has other parameters than the renderer."""
        try:
            renderer.load_state_dict(saved["renderer"])
        except RuntimeError as error:  # of torch, for missing, unknown and other shapes
            raise OtherState(" ".join(str(error).split())) from error
        # After the parameters: what the model learns of them has its own groups.
        self.optimiser = adam(renderer.rates(), eps=ADAM_EPS)
        self.optimiser.load_state_dict(saved["optimiser"])
        self.step, self.changed, self.losses = saved["step"], list(saved["changed"]), saved["losses"].tolist()
        self.history = [tuple(moment) for moment in saved["history"]]
        self.since_s -= saved.get("cpu_s", 0.0)
        self.cells = Cells(self.cells.box, saved["occupied"]).to(renderer.model.place)
        torch.set_rng_state(saved["generator"]["cpu"])
        if "cuda" in saved["generator"] and torch.cuda.is_available():
            torch.cuda.set_rng_state(saved["generator"]["cuda"])


def _step(
    renderer: VolumeRenderer, paths: Paths, training: Training, state: _State, water: WaterSurface | None
) -> None:
    """Take a step of Adam on some paths."""
    done = (state.step / training.steps - training.falls_from) / (1.0 - training.falls_from)
    set_rates(state.optimiser, training.final_rate ** max(done, 0.0))
    samples = renderer.samples(paths, state.cells, training.samples, jitter=True)
    rendered = renderer.render(paths, samples)
    error = ((rendered.rgb - paths.rgb) ** 2).mean()
    total = error + renderer.penalty(paths, rendered)
    total = total + added_loss(training.losses, renderer, paths, rendered, state.cells, water)
    descend(state.optimiser, total)
    state.losses.append(float(error.detach()))
    if renderer.model.observe(state.losses):
        state.changed.append(state.step)
        state.optimiser = adam(renderer.rates(), eps=ADAM_EPS)
    state.step += 1


@torch.no_grad()
def proxy_of(renderer: VolumeRenderer, cells: Cells, margin: float) -> Cells:
    """The cells of a proxy in which the volume itself stops light, and those within ``margin`` [m] of them.

    A cell counts if its opacity is a tenth or more, ten times that of a cell of fog that fills the box.
    """
    density = torch.cat([renderer.model.evaluate(part)[0] for part in cells.centres().split(CHUNK)])
    return cells.refined(1.0 - torch.exp(-density * cells.edge), 0.1, margin)


def _batches(
    photographs: Photographs, model: VolumeModel, training: Training, seed: int, start: int
) -> Iterator[Paths]:
    """Paths of each step from `start` on: as many whole patches as its rays hold, one at least.

    Each pool of `POOL_STEPS` steps has its own generator, so that it depends on nothing before.
    """
    patch = training.losses.patch
    patches = max(training.rays // patch**2, 1)
    for first in range(start - start % POOL_STEPS, training.steps, POOL_STEPS):
        count = min(POOL_STEPS, training.steps - first)
        pool = photographs.draw(count * patches, model.box, np.random.default_rng((seed, first)), patch).to(model.place)
        of_step = patches * patch**2
        for step in range(max(start - first, 0), count):
            yield pool[step * of_step : (step + 1) * of_step]


def adam(groups: list[Rates], *, eps: float) -> torch.optim.Adam:
    """Adam over those of the groups that have parameters."""
    columns = [{"params": g.parameters, "lr": g.rate, "top": g.rate} for g in groups if g.parameters]
    return torch.optim.Adam(columns, betas=(0.9, 0.99), eps=eps, fused=True)


def set_rates(optimiser: torch.optim.Adam, share: float) -> None:
    """Set the learning rates to a share of the initial ones."""
    for group in optimiser.param_groups:
        group["lr"] = group["top"] * share


def descend(optimiser: torch.optim.Adam, loss: torch.Tensor) -> None:
    """Take a step down the gradient of a loss."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()


def psnr_db(errors: list[float]) -> float:
    """Peak signal-to-noise ratio [dB] of mean squared errors of colours from 0 to 1."""
    return float(-10.0 * np.log10(np.mean(errors)))
