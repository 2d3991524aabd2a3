"""Appearance vectors of photographs, and a network of visibility, fitted to a trained volume, which stays as it is.

A vector per photograph stands for its exposure and light; it affects colour, never density. In the NeRF of tidal flats
(and before it in NeRF in the Wild, Martin-Brualla et al. 2021): [density, z] = MLP1(x), colour = MLP2(z, direction,
vector). Here MLP1 is the volume's `evaluate` and MLP2 its `radiance`.

Visibility is a small network f of position and direction, asked before a volume is rendered, as in Block-NeRF (Tancik
et al. 2022), and after it in the NeRF of tidal flats. With the samples i of the training's paths it minimises

    mean (f(x_i, d_i) - T_i)^2,  T_i = exp(-sum_{j<i} sigma_j l_j)                                                 (1)

sigma the density and l the lengths of the samples, which it does not change. It is near 1 in free space and on what the
photographs see, near 0 behind it, and between the two at places that some of them see. A view leaves out submodules of
which the mean of f over its paths is small. Both papers train f beside the field; here it is trained after it, on the
densities that the field ends with.
"""

from collections.abc import Callable

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

SAMPLES = 48  # Of each path


def appearance_vectors(photographs: int, length: int) -> nn.Embedding:
    """Vectors of so many photographs, which `Paths.view` counts, and numbers, all zero: each begins alike."""
    vectors = nn.Embedding(photographs, length)
    nn.init.zeros_(vectors.weight)
    return vectors


def match_appearance(
    renderer: VolumeRenderer,
    photographs: Photographs,
    cells: Cells,
    *,
    steps: int = 100,
    rays: int = 2048,
    seed: int = 0,
) -> nn.Embedding:
    """Vectors for photographs that a volume was not trained with, for its ``appearance``; see `fitted_vectors`.

    ``cells``: the proxy that training left.
    """
    rng, count = np.random.default_rng(seed), len(photographs.cameras)

    def draw() -> Paths:
        return photographs.draw(rays, renderer.model.box, rng)

    return fitted_vectors(renderer, count, cells, draw, steps=steps, seed=seed)


@half_the_threads()
def fitted_vectors(
    renderer: VolumeRenderer, count: int, cells: Cells, draw: Callable[[], Paths], *, steps: int, seed: int = 0
) -> nn.Embedding:
    """Vectors, so many, with which a trained volume has the colours of paths that are drawn anew in each step.

    `Paths.view` counts them. They begin as the mean of the volume's own vectors; all else stays. Raises ValueError if
    it has none.
    """
    own, place, cells = renderer.appearance, renderer.model.place, cells.to(renderer.model.place)
    if own is None:
        raise ValueError("the volume has no appearance vectors to match; train it with `appearance_vectors`")
    vectors = appearance_vectors(count, own.embedding_dim).to(place)
    vectors.weight.data += own.weight.detach().mean(dim=0)
    torch.manual_seed(seed)

    def loss() -> Tensor:
        paths = draw().to(place)
        rendered = renderer.render(paths, renderer.samples(paths, cells, SAMPLES, jitter=True))
        return ((rendered.rgb - paths.rgb) ** 2).mean()

    renderer.appearance = vectors
    try:
        _fit([vectors.weight], 0.05, steps, loss)
    finally:
        renderer.appearance = own
    return vectors


def _fit(parameters: list[Tensor], rate: float, steps: int, loss: Callable[[], Tensor]) -> None:
    """Steps of Adam down a loss, with a rate that falls along a cosine."""
    optimiser = torch.optim.Adam(parameters, lr=rate)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    for _ in range(steps):
        optimiser.zero_grad(set_to_none=True)
        loss().backward(inputs=parameters)
        optimiser.step()
        falling.step()


VIEW_SAMPLES, ACROSS = 8, 32  # Samples of a path of a view, and paths along the longer side of its picture
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

        ``cells``: the proxy of the volume.
        """
        paths = coarse_paths(camera, water, self.box)
        samples = cells.samples(paths, VIEW_SAMPLES, jitter=False)
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

    def loss() -> Tensor:
        paths = photographs.draw(rays, renderer.model.box, rng).to(place)
        with torch.no_grad():
            rendered = renderer.render(paths, renderer.samples(paths, cells, TRAINED_SAMPLES, jitter=True))
        return found.loss(paths, rendered)

    _fit(list(found.parameters()), RATE, steps, loss)
    return found
