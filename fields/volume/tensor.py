"""Planes times vectors in a box: VM, DW, M and MDW-NeRF are one model with four settings.

The loss of MDW-NeRF has a regulariser on the density features, for which the text gives no formula. Here it is that
of TensoRF (Chen et al. 2022) for factors, on the features themselves:

    L_features = mean |A_f| at a sample of each path                                                              (1)

Its colour as the paper prints it (`PrintedColour`):

    f_c = [G_n W_n], n = 1..L: products by element, W_n (D F numbers) of the position                             (2)
    c   = CRN(f_c, SH(d)): linear to N_c numbers, three times linear and GELU, linear to the three colours          (3)

The text does not say how W_n depends on the position; here it is a vector along each direction, as v_n of the factors,
in cells of the same size and linear between their middles. `fields.heads.ColourHead` has W_n constant and two hidden
maps, with which the field learns faster.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from fields.device import Device
from fields.factors import Factors, Grid, geometric_scales, nodes_of
from fields.heads import ColourHead, DensityHead, spherical_harmonics
from fields.lookup import axes_of
from fields.training import Rates, has_converged
from fields.volume.model import VolumeModel, density_of
from fields.volume.paths import Box


class ScaleWeights(nn.Module):
    """W_n of all scales: (samples, L D F) at box coordinates (samples, 3), one until it has learned."""

    def __init__(self, grids: list[Grid], directions: str, channels: int):
        super().__init__()
        self.axes = [(grid.along(axis), axis) for grid in grids for axis in (axes_of(m)[0] for m in directions)]
        self.vectors = nn.Parameter(torch.ones(sum(cells for cells, _ in self.axes), channels))

    def forward(self, u: Tensor) -> Tensor:
        found, first = [], 0
        for cells, axis in self.axes:
            left, right, share = nodes_of(u[:, axis], cells)
            found.append(torch.lerp(self.vectors[first + left], self.vectors[first + right], share))
            first += cells
        return torch.cat(found, dim=1)


class PrintedColour(nn.Module):
    """Equation (3): linear radiance (samples, 3), at least 0, of features (2), seen along unit directions."""

    def __init__(self, width: int, *, hidden: int, degree: int, extra: int):
        super().__init__()
        self.degree = degree
        layers: list[nn.Module] = [nn.Linear(width + (degree + 1) ** 2 - 1 + extra, hidden)]
        for _ in range(3):
            layers += [nn.Linear(hidden, hidden), nn.GELU()]
        self.network = nn.Sequential(*layers, nn.Linear(hidden, 3))

    def forward(self, features: Tensor, directions: Tensor | None, appearance: Tensor | None = None) -> Tensor:
        known = [features]
        if directions is not None:
            known.append(spherical_harmonics(directions, self.degree))
        if appearance is not None:
            known.append(appearance)
        return nn.functional.softplus(self.network(torch.cat(known, dim=1)), beta=4.0)


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
    shared: bool = True  # The weighting network is one of all scales; else each scale has its own
    directions: str = "xyz"  # Of "xyz", those with a vector
    reduction: int = 4  # r of the weighting network
    degree: int = 2  # Of the spherical harmonics in the colour head; 0 for a matt scene
    hidden: int = 32  # Width of the colour head
    printed_colour: bool = False  # Colour weights of the position and five maps, as in `fields.volume.tensor`
    features_l1: float = 0.0  # Weight of (1)
    # Learning rate of the factors after the switch. The paper's 0.001 is for 150,000 steps; in a thousand they hardly
    # change.
    fine_rate: float = 0.001
    # switch_window, switch_ratio float: the variance of the loss over the last ``window`` steps falls below ``ratio``
    # times that over the first
    switch_window: int = 100
    switch_ratio: float = 0.01

    @staticmethod
    def mdw(**changes) -> TensorSettings:
        """Multi-scale, density weighted: MDW-NeRF."""
        return replace(TensorSettings(), **changes)

    @staticmethod
    def published(**changes) -> TensorSettings:
        """MDW-NeRF with colour as printed and the regulariser of the density features, at TensoRF's weight."""
        return replace(TensorSettings(printed_colour=True, features_l1=8e-5), **changes)

    @staticmethod
    def m(**changes) -> TensorSettings:
        """Multi-scale alone."""
        return replace(TensorSettings(weighting=False), **changes)

    @staticmethod
    def dw(**changes) -> TensorSettings:
        """Settings of a density-weighted model of one scale."""
        return replace(TensorSettings(scales=1, channels=24), **changes)

    @staticmethod
    def vm(**changes) -> TensorSettings:
        """Settings of one scale, density a linear map of the features: the vector-matrix decomposition alone.

        As many features a sample as six scales of four channels have.
        """
        return replace(TensorSettings(scales=1, channels=24, weighting=False), **changes)


class TensorVolume(VolumeModel):
    """Density ``softplus(raw)`` per finest cell, from factors of all scales and directions; colour as MDW-NeRF.

    An untrained box lets a share of 1/e of the light through along its longest edge.

    Parameters
    ----------
    box : Box
    settings : TensorSettings
    device : Device
        Dr.Jit for fused lookups; "torch" for the reference implementation.
    appearance : int
        Length of the appearance vectors; 0 without.
    """

    # Adam's rates of MDW-NeRF; that of the factors falls to `TensorSettings.fine_rate` with the switch.
    FACTORS, WEIGHTING, COLOUR = 0.02, 0.02, 0.001

    def __init__(self, box: Box, settings: TensorSettings, device: Device, *, appearance: int = 0):
        super().__init__(box)
        self.settings = settings
        self.factors = Factors(self._grids(), settings.directions, settings.channels, device)
        shape = (settings.scales, len(settings.directions), settings.channels)
        self.regression = DensityHead(*shape, reduction=settings.reduction, device=device, shared=settings.shared)
        head_options = {"hidden": settings.hidden, "degree": settings.degree, "extra": appearance}
        if settings.printed_colour:
            self.weights = ScaleWeights(self.factors.grids, settings.directions, settings.channels)
            self.colour: nn.Module = PrintedColour(self.factors.num_features, **head_options)
        else:
            self.colour = ColourHead(*shape, **head_options)
        nn.init.ones_(self.regression.coarse.weight)

    def _grids(self) -> list[Grid]:
        of = self.settings
        return [grid_of(self.box, n) for n in geometric_scales(of.n_min, of.n_max, of.scales)]

    def evaluate(self, x: Tensor) -> tuple[Tensor, Tensor]:
        u = self.box.unit(x)
        features = self.factors(u)
        density = density_of(self.regression(features), self.settings.n_max, self.box.edge)
        return density, features * self.weights(u) if self.settings.printed_colour else features

    def penalty(self, x: Tensor) -> Tensor:
        """Equation (1), times its weight."""
        if not self.settings.features_l1:
            return x.new_zeros(())
        return self.settings.features_l1 * self.factors(self.box.unit(x)).abs().mean()

    def radiance(self, features: Tensor, direction: Tensor, appearance: Tensor | None) -> Tensor:
        return self.colour(features, -direction if self.settings.degree else None, appearance)

    def rates(self) -> list[Rates]:
        fine = self.regression.is_fine
        return [
            Rates([self.factors.planes, self.factors.vectors], self.settings.fine_rate if fine else self.FACTORS),
            Rates(list(self.regression.parameters()), self.WEIGHTING if fine else self.COLOUR),
            Rates([p for part in self._of_colour for p in part.parameters()], self.COLOUR),
        ]

    @property
    def _of_colour(self) -> list[nn.Module]:
        return [self.colour, self.weights] if self.settings.printed_colour else [self.colour]

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
