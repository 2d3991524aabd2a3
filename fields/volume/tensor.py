"""Planes times vectors in a box: VM, DW, M and MDW-NeRF are one model with four settings.

The paper prints colour as five maps of features times weights of the position, and a regulariser on the density
features without its formula. Here `fields.heads.ColourHead` has constant weights and three maps, with which the field
learns faster, and no regulariser (docs/decisions.md has what both gave).

In a thin layer about the bed (`fields.volume.layer`) raw density moves the bed:

    signed distance  d = zeta - half tanh(raw)
    transmittance    T(d) = 1 - exp(-d / width) / 2 above the bed, exp(d / width) / 2 below it; width is learned    (1)

The middle of a path's weights is the bed, for any width, and a field of zero the raster that the layer is about.
Vectors run along zeta alone: in a thin layer the other directions add nothing. The bed is matt.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from fields.device import Device
from fields.factors import Factors, Grid, anisotropic_grids, geometric_scales
from fields.heads import ColourHead, DensityHead
from fields.volume.layer import Layer
from fields.volume.model import Rates, Setup, VolumeModel, density_of, has_converged
from fields.volume.paths import Box
from fields.volume.sampling import log_transmittance


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
    fine_rate: float = 0.001  # Learning rate of the factors after the switch; see `FINE_RATE`
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


SCALES, CHANNELS = 4, 4  # Scales, and features of a sample, of the models of several scales and of one
# Cells of the coarsest scale over those of the finest, which are as long as those of the layer's raster.
COARSENING = 8.0
CELLS_IN_HALF = 4.0  # Finest cells in half of the layer
# Learning rate of the factors in a box after the switch to weighted density, of trainings with fewer steps than this:
# with the paper's 0.001, which is for 150,000, they hardly change in some thousands.
FINE_RATE, LONG = 0.02, 100_000
# Share of the steps in which colours are learned with the bed at rest: it would follow colours that are still wrong.
COLOUR_FIRST = 0.3


class LayerVolume(TensorVolume):
    """Density by (1), colour as MDW-NeRF; ``steps`` are those of the training."""

    FACTORS, WEIGHTING, COLOUR, WIDTH = 0.02, 0.005, 0.002, 0.005

    box: Layer

    def __init__(self, layer: Layer, settings: TensorSettings, device: Device, *, steps: int, appearance: int = 0):
        one = settings.scales == 1
        settings = replace(
            settings,
            scales=1 if one else SCALES,
            channels=SCALES * CHANNELS if one else CHANNELS,
            directions="z",
            reduction=2,
            degree=0,
            fine_rate=self.FACTORS,
        )
        super().__init__(layer, settings, device, appearance=appearance)
        nn.init.zeros_(self.regression.coarse.weight)
        # Half a cell: tails that reach a face of the layer pull the bed away from it.
        self.log_width = nn.Parameter(torch.log(torch.tensor(0.5 * layer.cell, dtype=torch.float32)))
        self.moves_bed, self._bed_from = False, COLOUR_FIRST * steps

    def _grids(self) -> list[Grid]:
        finest = np.array([self.box.cell, self.box.cell, self.box.half / CELLS_IN_HALF])
        return anisotropic_grids(self.box.size, finest, COARSENING, self.settings.scales)

    def _lift(self, features: Tensor) -> Tensor:
        """Height (S,) [m] of the bed over the raster."""
        return self.box.half * torch.tanh(self.regression(features))

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        features, width = self.factors(self.box.unit(x)), self.log_width.exp()
        d = self.box.above(x) - self._lift(features)
        tail = 0.5 * torch.exp(-d.clamp(min=0.0) / width)
        return tail / (1.0 - tail) / width, features

    def thickness(self, x: Tensor, direction: Tensor, length: Tensor) -> tuple[Tensor, Tensor]:
        half_way = 0.5 * length[:, None] * direction
        zeta = self.box.above(torch.stack([x - half_way, x + half_way]))
        features, width = self.factors(self.box.unit_at(x, zeta.mean(dim=0))), self.log_width.exp()
        start, end = log_transmittance(zeta - self._lift(features), width)
        # What the tail of the law takes above the layer counts to the first sample, so that the middle stays the bed.
        is_first = zeta[0] + 0.5 * (zeta[0] - zeta[1]) > self.box.half
        start = torch.where(is_first, 0.0, start)
        return (start - end).clamp(min=0.0), features

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        return self.colour(features, None, appearance)

    def rates(self) -> list[Rates]:
        return [
            Rates([self.factors.planes, self.factors.vectors], self.FACTORS),
            Rates(list(self.regression.parameters()), self.WEIGHTING if self.moves_bed else 0.0),
            Rates(list(self.colour.parameters()), self.COLOUR),
            Rates([self.log_width], self.WIDTH if self.moves_bed else 0.0),
        ]

    def observe(self, losses: list[float]) -> bool:
        if self.moves_bed:
            return super().observe(losses)
        self.moves_bed = len(losses) >= self._bed_from
        return self.moves_bed

    def get_extra_state(self) -> dict:
        return super().get_extra_state() | {"moves_bed": self.moves_bed}

    def set_extra_state(self, state: dict) -> None:
        super().set_extra_state(state)
        self.moves_bed = state["moves_bed"]


def _tensor(of: Setup, settings: TensorSettings) -> TensorVolume:
    if isinstance(of.box, Layer):
        return LayerVolume(of.box, settings, of.device, steps=of.steps, appearance=of.appearance)
    rate = FINE_RATE if of.steps < LONG else settings.fine_rate
    settings = replace(settings, n_min=max(of.cells // 4, 2), n_max=of.cells, fine_rate=rate)
    return TensorVolume(of.box, settings, of.device, appearance=of.appearance)


# The models by their names, each made of a `fields.volume.model.Setup`: several scales, and weighted density.
mdw = partial(_tensor, settings=TensorSettings())
m = partial(_tensor, settings=TensorSettings(weighting=False))
dw = partial(_tensor, settings=TensorSettings.of_one_scale(weighting=True))
vm = partial(_tensor, settings=TensorSettings.of_one_scale(weighting=False))
