"""What every volume model has to do, whatever it is made of: its interface, and learning a bed seen through water."""

import copy
import io
from collections.abc import Callable

import numpy as np
import torch
from volume_scenes import BOX, bed_photographs

from fields.volume.model import VolumeModel
from fields.volume.nerfacto import Proposal
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.train import Training, train_volume
from fields.water_column import WaterColumn

APPEARANCE = 3
Make = Callable[[int], VolumeModel]


def positions(num: int, *, seed: int = 0, dtype=torch.float32) -> torch.Tensor:
    """Positions (num, 3) [m] in the box."""
    drawn = np.random.default_rng(seed).uniform(BOX.low, BOX.high, (num, 3))
    return torch.as_tensor(drawn, dtype=dtype)


def directions(num: int, *, seed: int = 1, dtype=torch.float32) -> torch.Tensor:
    """Unit directions (num, 3)."""
    drawn = np.random.default_rng(seed).standard_normal((num, 3))
    return torch.as_tensor(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), dtype=dtype)


def seeded(make: Make, seed: int, appearance: int = APPEARANCE) -> VolumeModel:
    """A model for the box, drawn from a seed."""
    torch.manual_seed(seed)
    return make(appearance)


def outputs(model: VolumeModel, appearance: torch.Tensor) -> list[torch.Tensor]:
    """Thickness, features, colour and penalty at 50 places with one appearance vector."""
    x, d = positions(50), directions(50)
    thickness, features = model.thickness(x, d, torch.full((50,), 0.1))
    colour = model.radiance(features, d, appearance.expand(50, -1) if len(appearance) else None)
    return [thickness, features, colour, model.penalty(x)]


def store_and_load(model: torch.nn.Module, other: torch.nn.Module) -> None:
    """Load the stored state of a model into another one."""
    stored = io.BytesIO()
    torch.save(model.state_dict(), stored)
    stored.seek(0)
    other.load_state_dict(torch.load(stored, weights_only=True))


def require_rates(model: VolumeModel | VolumeRenderer) -> None:
    """That every parameter learns at one rate."""
    learning = [id(p) for group in model.rates() for p in group.parameters]
    assert sorted(learning) == sorted(id(p) for p in model.parameters())


def check_interface(make: Make) -> None:
    """Densities and colours are lawful, every parameter learns at one rate, and a model comes back bit for bit."""
    model, look = seeded(make, 0), torch.tensor([0.3, -0.2, 0.8])
    density, _ = model.evaluate(positions(50))
    found = outputs(model, look)
    assert density.shape == (50,)
    assert (density > 0.0).all()
    assert (found[0] >= 0.0).all()
    assert (found[2] >= 0.0).all()
    assert found[2].shape == (50, 3)
    assert all(bool(torch.isfinite(f).all()) for f in found)

    other = outputs(model, -look)
    assert torch.equal(other[0], found[0])
    assert torch.equal(other[1], found[1])
    assert (other[2] != found[2]).any(dim=0).all()

    sum(f.sum() for f in (found[0], found[2], found[3])).backward()
    assert [name for name, p in model.named_parameters() if p.grad is None or not p.grad.any()] == []
    require_rates(model)

    again = seeded(make, 1)
    assert not torch.equal(outputs(again, look)[2], found[2])
    store_and_load(model, again)
    assert all(torch.equal(a, b) for a, b in zip(outputs(again, look), found, strict=True))


def check_learning(make: Make, *, steps: int, share: float, proposal: Proposal | None = None) -> VolumeRenderer:
    """The error on photographs of a painted bed under 1.5 m of water falls to a share of it within few steps."""
    renderer = VolumeRenderer(seeded(make, 0, 0), column=WaterColumn(), proposal=proposal)
    photographs, cells = bed_photographs(views=4), Cells.everywhere(BOX, 32)
    paths = photographs.draw(400, BOX, np.random.default_rng(7))

    def error() -> float:
        with torch.no_grad():
            rendered = renderer.render(paths, renderer.samples(paths, cells, 32, jitter=False))
        return float(((rendered.rgb - paths.rgb) ** 2).mean())

    before = error()
    training = Training(steps=steps, rays=128, samples=24, refresh=(), final_rate=0.3)
    train_volume(renderer, photographs, training, lambda *done: None, cells=cells)
    assert error() < share * before
    return renderer


class Interrupted(Exception):
    """What stops a training."""


class Kept:
    """Checkpoints in memory; the one at a step is the last."""

    def __init__(self, stop_at: int | None = None):
        self.stop_at, self.state = stop_at, None

    def load(self):
        return self.state

    def save(self, make, *, last):
        self.state = copy.deepcopy(make())
        if self.state["step"] == self.stop_at:
            raise Interrupted
