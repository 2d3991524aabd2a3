"""Learning rates, a step down the gradient, and convergence of a training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Rates:
    """A group of parameters with its learning rate for Adam."""

    parameters: list[nn.Parameter]
    rate: float


def adam(groups: list[Rates], *, eps: float) -> torch.optim.Adam:
    """Adam over those of the groups that have parameters."""
    columns = [{"params": g.parameters, "lr": g.rate, "top": g.rate} for g in groups if g.parameters]
    return torch.optim.Adam(columns, betas=(0.9, 0.99), eps=eps, fused=True)


def set_rates(optimiser: torch.optim.Adam, share: float) -> None:
    """Set the learning rates to a share of the initial ones."""
    for group in optimiser.param_groups:
        group["lr"] = group["top"] * share


def descend(optimiser: torch.optim.Adam, loss: Tensor) -> None:
    """Take a step down the gradient of a loss."""
    optimiser.zero_grad(set_to_none=True)
    loss.backward()
    optimiser.step()


def has_converged(losses: list[float], window: int, ratio: float) -> bool:
    """Whether the variance of the last ``window`` losses is below ``ratio`` times that of the first."""
    if len(losses) < 2 * window:
        return False
    return bool(np.var(losses[-window:]) < ratio * np.var(losses[:window]))


def psnr_db(errors: list[float]) -> float:
    """Peak signal-to-noise ratio [dB] of mean squared errors of colours from 0 to 1."""
    return float(-10.0 * np.log10(np.mean(errors)))
