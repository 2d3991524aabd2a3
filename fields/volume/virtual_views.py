"""Consistency with virtual views: equal colour and depth from a camera nearby.

MonoPatchNeRF (Wu et al. 2024) renders virtual views close to the photographs' own and holds them to what those show.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from fields.volume.paths import Box, Paths, paths_along
from fields.volume.renderer import Rendered, VolumeRenderer
from fields.volume.sampling import Cells
from refract import WaterSurface, crossing_point

# Distance of virtual cameras from the photograph's, as a share of the mean path length.
BASELINE = 0.1
# One in this many paths of a batch gets a virtual view.
EVERY = 4
# A point is hidden where the virtual view stops these many cells of the proxy before it.
HIDDEN_CELLS = 3.0
# Samples of a virtual path.
SAMPLES = 48


def virtual_view_loss(
    renderer: VolumeRenderer, paths: Paths, rendered: Rendered, cells: Cells, water: WaterSurface | None
) -> Tensor:
    """Squared error of colour, and error of depth in edges of the box, in virtual views of the surfaces met.

    The points at the median of the weights are taken as they are, without gradient. Colours are compared with those
    photographed; weights of the virtual paths are drawn to the point. Points that the virtual view hides are left out.
    """
    paths, rendered = paths[::EVERY], _thinned(rendered)
    seen = (rendered.opacity > 0.5) & (paths.near < paths.far)
    if not seen.any():
        return torch.zeros(())
    paths, depth = paths[seen], rendered.depth[seen]
    points = paths.at(depth[:, None])[:, 0]
    centres = paths.origin + BASELINE * depth.mean() * _offsets(paths.view)
    moved, length = paths_through(centres, points, water, paths, renderer.model.box)
    again = renderer.render(moved, renderer.samples(moved, cells, SAMPLES, jitter=True))
    cell = cells.box.edge / max(cells.occupied.shape)
    shown = ((again.depth > length - HIDDEN_CELLS * cell) & (moved.near < moved.far)).detach()
    colour = ((again.rgb - paths.rgb) ** 2).mean(dim=1)
    away = (again.weights * (again.samples.s - length[:, None]).abs()).sum(dim=1) / renderer.model.box.edge
    return ((colour + away) * shown).sum() / shown.sum().clamp(min=1)


def paths_through(
    centres: Tensor, points: Tensor, water: WaterSurface | None, seen: Paths, box: Box
) -> tuple[Paths, Tensor]:
    """Paths from centres (N, 3) through points (N, 3) [m], bent at the water, and the lengths (N,) [m] to the points.

    They carry the colours and views of the paths ``seen``. A point that no light reaches has a path that misses the
    box.
    """
    origin, target = (v.detach().double().numpy() for v in (centres, points))
    entry = crossing_point(target, origin, water)
    first = np.linalg.norm(entry - origin, axis=-1, keepdims=True)
    direction = (entry - origin) / np.maximum(first, 1e-9)
    moved = paths_along(origin, direction, water, seen.rgb, box, seen.view)
    length = first[:, 0] + np.linalg.norm(target - entry, axis=-1)
    return moved, torch.as_tensor(length, dtype=points.dtype)


def _offsets(view: Tensor) -> Tensor:
    """A random unit vector (N, 3) for each view, the same for all of its paths."""
    directions = torch.nn.functional.normalize(torch.randn(int(view.max()) + 1, 3), dim=1)
    return directions[view]


@torch.no_grad()
def _thinned(rendered: Rendered) -> Rendered:
    samples = rendered.samples
    thin = type(samples)(*(getattr(samples, n)[::EVERY] for n in ("s", "length", "edges")))
    return Rendered(rendered.rgb[::EVERY].detach(), rendered.weights[::EVERY].detach(), thin)
