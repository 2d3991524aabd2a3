"""Planes times vectors in a box: VM, DW, M and MDW-NeRF are one model with four settings.

The paper prints colour as five maps of features times weights of the position, and a regulariser on the density
features without its formula. Here `fields.heads.ColourHead` has constant weights and three maps, with which the field
learns faster, and no regulariser (docs/decisions.md has what both gave).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from torch import Tensor, nn

from fields.device import Device
from fields.factors import Factors, Grid, geometric_scales
from fields.heads import ColourHead, DensityHead
from fields.training import Rates, has_converged
from fields.volume.model import VolumeModel, density_of
from fields.volume.paths import Box


@dataclass(frozen=True)
class TensorSettings:
    """Settings of a plane-times-vector volume."""

    # scales, channels: L and n_f of the paper
    scales: int = 6
    channels: int = 4
    # n_min, n_max: Cells along the longest edge at the coarsest and the finest scale; one scale has n_max
    n_min: int = 64
    n_max: int = 256
    # The density weighting network takes over from the coarse regression once the loss has converged
    weighting: bool = True
    directions: str = "xyz"  # Of "xyz", those with a vector
    reduction: int = 4  # r of the weighting network
    degree: int = 2  # Of the spherical harmonics in the colour head; 0 for a matt scene
    hidden: int = 32  # Width of the colour head
    # Learning rate of the factors after the switch. The paper's 0.001 is for 150,000 steps; in a thousand they hardly
    # change.
    fine_rate: float = 0.001
    # switch_window, switch_ratio float: the variance of the loss over the last ``window`` steps falls below ``ratio``
    # times that over the first
    switch_window: int = 100
    switch_ratio: float = 0.01

    @staticmethod
    def of_one_scale(*, weighting: bool) -> TensorSettings:
        """Settings of DW, or without weighting VM: the vector-matrix decomposition alone, density linear in features.

        As many features a sample as six scales of four channels have.
        """
        return TensorSettings(scales=1, channels=24, weighting=weighting)


class TensorVolume(VolumeModel):
    """Density ``softplus(raw)`` per finest cell, from factors of all scales and directions; colour as MDW-NeRF.

    An untrained box lets a share of 1/e of the light through along its longest edge.
    """

    # Adam's rates of MDW-NeRF; that of the factors falls to `TensorSettings.fine_rate` with the switch.
    FACTORS, WEIGHTING, COLOUR = 0.02, 0.02, 0.001

    def __init__(self, box: Box, settings: TensorSettings, device: Device, *, appearance: int = 0):
        super().__init__(box)
        self.settings = settings
        self.factors = Factors(self._grids(), settings.directions, settings.channels, device)
        shape = (settings.scales, len(settings.directions), settings.channels)
        self.regression = DensityHead(*shape, reduction=settings.reduction, device=device)
        self.colour = ColourHead(*shape, hidden=settings.hidden, degree=settings.degree, extra=appearance)
        nn.init.ones_(self.regression.coarse.weight)

    def _grids(self) -> list[Grid]:
        of = self.settings
        return [grid_of(self.box, n) for n in geometric_scales(of.n_min, of.n_max, of.scales)]

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        features = self.factors(self.box.unit(x))
        return density_of(self.regression(features), self.settings.n_max, self.box.edge), features

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        return self.colour(features, -direction if self.settings.degree else None, appearance)

    def rates(self) -> list[Rates]:
        fine = self.regression.is_fine
        return [
            Rates([self.factors.planes, self.factors.vectors], self.settings.fine_rate if fine else self.FACTORS),
            Rates(list(self.regression.parameters()), self.WEIGHTING if fine else self.COLOUR),
            Rates(list(self.colour.parameters()), self.COLOUR),
        ]

    def observe(self, losses: list[float]) -> bool:
        of = self.settings
        if self.regression.is_fine or not of.weighting or not has_converged(losses, of.switch_window, of.switch_ratio):
            return False
        self.regression.switch_to_fine()
        return True

    def get_extra_state(self) -> dict:
        return {"is_fine": self.regression.is_fine}

    def set_extra_state(self, state: dict) -> None:
        self.regression.is_fine = state["is_fine"]


def grid_of(box: Box, num: float) -> Grid:
    """Cells of a box, ``num`` along its longest edge and as long along the others; at least two."""
    cells = np.maximum(np.round(num * box.size / box.edge), 2).astype(int)
    return Grid(*cells.tolist())
