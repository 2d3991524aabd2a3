"""A volume as a camera sees it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from fields.device import half_the_threads
from fields.volume.paths import paths_of
from fields.volume.renderer import VolumeRenderer
from fields.volume.sampling import Cells
from refract import PinholeCamera, WaterSurface

# Memory for the samples of paths rendered together: more is no faster, since it exceeds the cache; on a GPU less is
# slower, since it is not filled.
WORKING_BYTES = {"cpu": 16 << 20, "cuda": 1 << 30}
BYTES_PER_NUMBER = 4


@dataclass(frozen=True)
class View:
    """View of a volume by a camera; where a path misses the box, the background, and NaN for distance and point.

    Attributes
    ----------
    rgb : (height, width, 3) float32
        As a photograph stores it, 0 to 1.
    distance : (height, width) float32 [m]
        Along the path to the median of the weights.
    opacity : (height, width) float32
    points : (height, width, 3) float32 [m]
        Position of the path at `distance`.
    """

    rgb: np.ndarray
    distance: np.ndarray
    opacity: np.ndarray
    points: np.ndarray


@half_the_threads()
@torch.no_grad()
def render_volume(
    renderer: VolumeRenderer,
    camera: PinholeCamera,
    water: WaterSurface | None,
    cells: Cells,
    *,
    samples: int = 48,
    view: int = 0,
    dry: bool = False,
    chunk: int | None = None,
) -> View:
    """A volume as a camera sees it, with the appearance of photograph ``view``.

    Paths are rendered ``chunk`` at a time; by default as many as keep their samples within `WORKING_BYTES`, so that a
    model with wider features takes more chunks, not more memory.
    """
    chunk = chunk or chunk_of(renderer, samples)
    pixels = camera.pixel_centres().reshape(-1, 2)
    none = np.zeros((len(pixels), 3))
    place = renderer.model.place
    parts, cells = [], cells.to(place)
    for first in range(0, len(pixels), chunk):
        rows = slice(first, first + chunk)
        paths = paths_of(camera, water, pixels[rows], none[rows], renderer.model.box, view).to(place)
        seen = renderer.render(paths, renderer.samples(paths, cells, samples, jitter=False), dry=dry)
        depth = torch.where(paths.far > paths.near, seen.depth, torch.nan)
        parts.append((seen.rgb.clamp(max=1.0), depth, seen.opacity, paths.at(depth[:, None])[:, 0]))
    shape = (camera.height, camera.width)
    columns = [torch.cat(column).cpu().numpy() for column in zip(*parts, strict=True)]
    return View(*(c.reshape(*shape, *c.shape[1:]) for c in columns))


def chunk_of(renderer: VolumeRenderer, samples: int) -> int:
    """Number of paths that are rendered together, so that their samples take `WORKING_BYTES`."""
    working = WORKING_BYTES[renderer.model.place.type]
    return max(working // (BYTES_PER_NUMBER * samples * _numbers_per_sample(renderer)), 64)


def _numbers_per_sample(renderer: VolumeRenderer) -> int:
    """Features, as they are, weighted, picked and joined to the direction; and some 60 others."""
    return 4 * renderer.model.num_features + 60
