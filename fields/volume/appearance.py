"""A vector per photograph for its exposure and light; it affects colour, never density.

In the NeRF of tidal flats (and before it in NeRF in the Wild, Martin-Brualla et al. 2021): [density, z] = MLP1(x),
colour = MLP2(z, direction, vector). Here MLP1 is the volume's `evaluate` and MLP2 its `radiance`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import nn

from fields.device import half_the_threads
from fields.volume.paths import Paths
from fields.volume.photographs import Photographs
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells

# Of each path.
SAMPLES = 48


def appearance_vectors(photographs: int, length: int) -> nn.Embedding:
    """Vectors of ``length`` numbers, all zero: every photograph begins with the same appearance.

    Parameters
    ----------
    photographs : int
        How many there are; `Paths.view` counts them from 0.
    length : int
        As ``appearance`` of the volume.
    """
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
    """Appearance vectors with which a trained volume matches other photographs; all else is unchanged.

    Appearance matching of a submodule to its neighbour in the NeRF of tidal flats: about 100 steps, from the mean of
    the volume's own vectors. Raises ValueError if the renderer has no appearance vectors.

    Parameters
    ----------
    photographs : Photographs
        Of the same place, not those that it was trained with.
    cells : Cells
        The proxy that training left.

    Returns
    -------
    nn.Embedding
        A vector for each of the photographs; give it to the renderer as its ``appearance`` to see it with them.
    """
    rng, count = np.random.default_rng(seed), len(photographs.cameras)
    return fitted_vectors(
        renderer, count, cells, lambda: photographs.draw(rays, renderer.model.box, rng), steps=steps, seed=seed
    )


@half_the_threads()
def fitted_vectors(
    renderer: VolumeRenderer,
    count: int,
    cells: Cells,
    draw: Callable[[], Paths],
    *,
    steps: int,
    seed: int = 0,
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
    optimiser = torch.optim.Adam(vectors.parameters(), lr=0.05)
    falling = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)
    renderer.appearance = vectors
    try:
        for _ in range(steps):
            paths = draw().to(place)
            rendered = renderer.render(paths, renderer.samples(paths, cells, SAMPLES, jitter=True))
            error = ((rendered.rgb - paths.rgb) ** 2).mean()
            optimiser.zero_grad(set_to_none=True)
            error.backward(inputs=[vectors.weight])
            optimiser.step()
            falling.step()
    finally:
        renderer.appearance = own
    return vectors
