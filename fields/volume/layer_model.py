"""The tensor field of a thin layer about the bed: its raw density moves the bed (`fields.volume.layer`).

    signed distance  d = zeta - half tanh(raw)
    transmittance    T(d) = 1 - exp(-d / width) / 2 above the bed, exp(d / width) / 2 below it; width is learned    (1)

The middle of a path's weights is the bed, for any width, and a field of zero the raster that the layer is about.
Vectors run along zeta alone: in a thin layer the other directions add nothing. The bed is matt.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import torch
from torch import Tensor, nn

from fields.compositing import log_transmittance
from fields.device import Device
from fields.factors import Grid, anisotropic_grids
from fields.training import Rates
from fields.volume.layer import Layer
from fields.volume.model import Setup
from fields.volume.tensor import TensorSettings, TensorVolume

# Scales, and features of a sample, of the models of several scales and of one.
SCALES, CHANNELS = 4, 4
# Cells of the coarsest scale over those of the finest, which are as long as those of the layer's raster.
COARSENING = 8.0
# Finest cells in half of the layer.
CELLS_IN_HALF = 4.0
# Learning rate of the factors in a box after the switch to weighted density: with the paper's 0.001, which is for
# 150,000 steps, they hardly change in some thousands.
FINE_RATE = 0.02
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
    settings = replace(settings, n_min=max(of.cells // 4, 2), n_max=of.cells, fine_rate=FINE_RATE)
    return TensorVolume(of.box, settings, of.device, appearance=of.appearance)


# The models by their names, each made of a `fields.volume.model.Setup`: several scales, and weighted density.
mdw = partial(_tensor, settings=TensorSettings())
m = partial(_tensor, settings=TensorSettings(weighting=False))
dw = partial(_tensor, settings=TensorSettings.of_one_scale(weighting=True))
vm = partial(_tensor, settings=TensorSettings.of_one_scale(weighting=False))
