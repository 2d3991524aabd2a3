"""Visibility of a volume: a small network of the transmittance of its paths, asked before it is rendered.

In Block-NeRF (Tancik et al. 2022), and after it in the NeRF of tidal flats, a submodule has a perceptron f of position
and direction beside its field. With the samples i of the training's paths it minimises

    mean (f(x_i, d_i) - T_i)^2,  T_i = exp(-sum_{j<i} sigma_j l_j)                                                 (1)

sigma the density and l the lengths of the samples, which it does not change. It is near 1 in free space and on what the
photographs see, near 0 behind it, and between the two at places that some of them see. A view leaves out submodules of
which the mean of f over its paths is small. Both papers train f beside the field; here it is trained after it, on the
densities that the field ends with.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from fields.device import half_the_threads
from fields.heads import perceptron
from fields.volume.paths import Box, Paths, paths_of
from fields.volume.photographs import Photographs, even_pixels
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells
from fields.volume.shell import HIDDEN, OCTAVES, octaves
from refract import PinholeCamera, WaterSurface

# Samples of a path of a view, and paths along the longer side of its picture.
SAMPLES, ACROSS = 8, 32
# Samples of a path in training.
TRAINED_SAMPLES = 24
RATE = 0.005


class Visibility(nn.Module):
    """The transmittance (S,), 0 to 1, with which positions (S, 3) [m] in a box are seen along directions (S, 3)."""

    def __init__(self, box: Box):
        super().__init__()
        self.box = box
        self.network = perceptron(3 * (1 + 2 * OCTAVES) + 3, HIDDEN, HIDDEN, 1, activation=nn.GELU)

    def forward(self, x: Tensor, direction: Tensor) -> Tensor:
        place = octaves(2.0 * self.box.unit(x) - 1.0)
        return torch.sigmoid(self.network(torch.cat([place, direction], dim=-1))[..., 0])

    def loss(self, paths: Paths, rendered: Rendered) -> Tensor:
        """Equation (1), a scalar, over all samples of paths that meet the box."""
        s = rendered.samples.s
        error = self(paths.at(s), paths.direction(s)) - transmittance(rendered.weights).detach()
        return (error[paths.far > paths.near] ** 2).mean()

    @torch.no_grad()
    def of_view(self, camera: PinholeCamera, water: WaterSurface | None, cells: Cells) -> float:
        """Mean visibility of the volume in the picture of a camera, 0 where its paths miss the box.

        Parameters
        ----------
        cells : Cells
            The proxy of the volume.
        """
        paths = coarse_paths(camera, water, self.box)
        samples = cells.samples(paths, SAMPLES, jitter=False)
        seen = self(paths.at(samples.s), paths.direction(samples.s)).mean(dim=1)
        return float(torch.where(paths.far > paths.near, seen, 0.0).mean())


def transmittance(weights: Tensor) -> Tensor:
    """T (N, K) of samples with weights ``T_i (1 - exp(-sigma_i l_i))`` (N, K): what those before them let pass."""
    return (1.0 - torch.cumsum(weights, dim=1) + weights).clamp(0.0, 1.0)


def coarse_paths(camera: PinholeCamera, water: WaterSurface | None, box: Box) -> Paths:
    """Paths through an even grid of the picture of a camera, `ACROSS` along its longer side, clipped to a box."""
    pixels = even_pixels(camera, max(camera.width, camera.height) / ACROSS)
    return paths_of(camera, water, pixels, np.zeros((len(pixels), 3), dtype=np.uint8), box)


@half_the_threads()
def train_visibility(
    renderer: VolumeRenderer,
    photographs: Photographs,
    cells: Cells,
    *,
    steps: int = 200,
    rays: int = 1024,
    seed: int = 0,
) -> Visibility:
    """The visibility of a trained volume, which stays as it is, from the paths of its photographs."""
    torch.manual_seed(seed)
    rng, place = np.random.default_rng(seed), renderer.model.place
    found, cells = Visibility(renderer.model.box).to(place), cells.to(place)
    optimiser = torch.optim.Adam(found.parameters(), lr=RATE)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        paths = photographs.draw(rays, renderer.model.box, rng).to(place)
        with torch.no_grad():
            rendered = renderer.render(paths, renderer.samples(paths, cells, TRAINED_SAMPLES, jitter=True))
        loss = found.loss(paths, rendered)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        falling.step()
    return found
