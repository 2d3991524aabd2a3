"""The interface of all radiance fields over a box: density, colour, learning rates."""

import math
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from fields.device import Device
from fields.models import maker
from fields.volume.paths import Box


@dataclass(frozen=True)
class Setup:
    """What a model is built for."""

    box: Box
    cells: int  # Along the longest edge of the box at the finest scale; models without cells ignore it
    device: Device  # Dr.Jit for fused lookups of those with planes; "torch" for the reference implementation
    appearance: int = 0  # Length of the vectors of photographs; 0 for none
    steps: int = 2000  # Of the training that follows


@dataclass(frozen=True)
class Rates:
    """A group of parameters with its learning rate for Adam."""

    parameters: list[nn.Parameter]
    rate: float


class VolumeModel(nn.Module):
    """Density and colour in a box; models take what a `Setup` has of them, and settings of their own."""

    def __init__(self, box: Box):
        super().__init__()
        self.box = box

    @property
    def place(self) -> torch.device:
        """Device of its parameters and inputs; the host for a model without parameters."""
        return next(self.parameters(), torch.empty(0)).device

    @property
    def num_features(self) -> int:
        """F of `evaluate`."""
        middle = torch.as_tensor(0.5 * (self.box.low + self.box.high), dtype=torch.float32, device=self.place)
        with torch.no_grad():
            return self.evaluate(middle[None])[1].shape[1]

    @abstractmethod
    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """Density (S,) [1/m] and features (S, F) at positions (S, 3) [m], local."""

    @abstractmethod
    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        """Linear radiance (S, 3), at least 0, seen along unit directions of travel (S, 3) in the medium of the sample.

        ``appearance`` (S, A) is the vector of each sample's photograph. It touches colour, never density.
        """

    @abstractmethod
    def rates(self) -> list[Rates]:
        """Every parameter once, with its learning rate; read again whenever `observe` reports a change of the model."""

    def proposal(self, setup: Setup) -> nn.Module | None:
        """A `fields.volume.nerfacto.Proposal` that draws the samples in place of the occupied cells; None for those."""
        return None

    def thickness(self, x: Tensor, direction: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        """Density times length (S,) of pieces of path about positions (S, 3) [m], and features (S, F)."""
        density, features = self.evaluate(x)
        return density * length, features

    def observe(self, losses: list[float]) -> bool:
        """Hook after each step, with all losses so far; True where the model changed its parameters or rates."""
        return False

    def penalty(self, x: Tensor) -> Tensor:
        """A scalar loss of the model itself in training, beside the photographs, at positions (S, 3) [m]."""
        return x.new_zeros(())

    def normals(self, x: Tensor, step: float) -> Tensor:
        """Outward unit normals (S, 3) at positions (S, 3) [m]: against the gradient of density.

        By central differences of ``step`` [m] to each side; zero where density is constant. Gradients flow to the
        parameters.
        """
        steps = step * torch.eye(3, device=x.device)
        ends = torch.cat([x + a for a in steps] + [x - a for a in steps])
        after, before = self.evaluate(ends)[0].view(2, 3, -1)
        return nn.functional.normalize(((before - after) / (2.0 * step)).T, dim=1)


def density_of(raw: Tensor, cells: float, edge: float) -> Tensor:
    """Density (S,) [1/m], ``softplus(raw + b)`` per finest detail of a model, which has ``cells`` along ``edge`` [m].

    ``b = log(exp(1 / cells) - 1)``: where all raw numbers (S,) are zero, a share of 1/e of the light passes the edge.
    """
    return nn.functional.softplus(raw + math.log(math.expm1(1.0 / cells))) * (cells / edge)


def build_model(name: str, setup: Setup, *, seed: int = 0) -> VolumeModel:
    """An untrained model by its name, as in `fields.models.maker`, drawn from a seed.

    Raises ValueError or TypeError if there is no such model, or what the name stands for makes none.
    """
    make = maker(name)
    torch.manual_seed(seed)
    model = make(setup)
    if not isinstance(model, VolumeModel):
        raise TypeError(f"the model {name} is a {type(model).__name__}, expected a fields.volume.model.VolumeModel")
    return model


def has_converged(losses: list[float], window: int, ratio: float) -> bool:
    """Whether the variance of the last ``window`` losses is below ``ratio`` times that of the first."""
    if len(losses) < 2 * window:
        return False
    return bool(np.var(losses[-window:]) < ratio * np.var(losses[:window]))
