"""Training shared by the survey's field and volumes: learning rates, a step, and convergence.

The two loops stay apart. The field's knows its number of steps from the size of its slab, holds the bed while colours
learn, and compares colours alone; a volume's renews its proxy, draws patches, adds losses, and begins with a new
optimiser when its model changes. In one loop each of these would be a switch that the other never sets.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Rates:
    """A group of parameters with its learning rate for Adam, and a name used to freeze it."""

    parameters: list[nn.Parameter]
    rate: float
    name: str = ""


def adam(groups: list[Rates], *, eps: float) -> torch.optim.Adam:
    """Adam over those of the groups that have parameters."""
    columns = [{"params": g.parameters, "lr": g.rate, "top": g.rate, "name": g.name} for g in groups if g.parameters]
    return torch.optim.Adam(columns, betas=(0.9, 0.99), eps=eps, fused=True)


def set_rates(optimiser: torch.optim.Adam, share: float, *, held: Collection[str] = ()) -> None:
    """Set the learning rates to a share of the initial ones; zero for frozen groups."""
    for group in optimiser.param_groups:
        group["lr"] = 0.0 if group["name"] in held else group["top"] * share


def descend(optimiser: torch.optim.Adam, loss: Tensor) -> None:
    """Take a step down the gradient of a loss."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()


def has_converged(losses: list[float], window: int, ratio: float, *, variance: float | None = None) -> bool:
    """The variance of the last ``window`` losses is below ``ratio`` times that of the first, or below ``variance``."""
    if len(losses) < 2 * window:
        return False
    limit = ratio * np.var(losses[:window]) if variance is None else variance
    return bool(np.var(losses[-window:]) < limit)


def psnr_db(errors: list[float]) -> float:
    """Peak signal-to-noise ratio [dB] of mean squared errors of colours from 0 to 1."""
    return float(-10.0 * np.log10(np.mean(errors)))
