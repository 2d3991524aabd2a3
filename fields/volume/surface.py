"""The surface of a volume: where each path of the photographs meets it, and what several photographs agree on."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from fields.device import half_the_threads
from fields.models import Rule
from fields.volume.paths import Box, Paths, paths_of
from fields.volume.photographs import Photographs
from fields.volume.renderer import Rendered, VolumeRenderer, chunk_of
from fields.volume.sampling import Cells
from refract import FlatWater

LEAST_OPACITY = 0.5  # Less of the light of a path than this meets no surface
LEAST_VIEWS = 2  # Photographs that a cell of the surface needs
SAMPLE = 4096  # Paths of which one has to meet a surface before all of them are followed


@dataclass(frozen=True)
class Surface:
    """Points (N) of a surface, each the mean of a cell in which photographs agree."""

    xyz: np.ndarray  # (N, 3) float64 [m], local
    rgb: np.ndarray  # (N, 3) uint8: as photographs store it
    std: np.ndarray  # (N,) [m]: of the height in a cell, between photographs, over the root of their number
    num_views: np.ndarray  # (N,) int
    incidence: np.ndarray  # (N,) [rad]: of the paths at the water in air, mean


def distance_of(rendered: Rendered, rule: Rule = Rule.median, density: float = 0.0) -> Tensor:
    """Path lengths (N,) [m] to the surface; NaN where a path meets none.

    The last sample of a path is opaque where nothing lies behind the box (`with_opaque_end`): it is no surface.
    ``density`` [1/m]: of ``Rule.density``.
    """
    samples, weights = rendered.samples, rendered.weights
    if rule is Rule.median:
        distance = rendered.depth
    elif rule is Rule.mode:
        distance = samples.s.gather(1, weights.argmax(dim=1, keepdim=True))[:, 0]
    else:
        passed = (1.0 - torch.cumsum(weights, dim=1) + weights).clamp(min=1e-6)
        dense = -torch.log1p(-(weights / passed).clamp(max=1.0 - 1e-6)) > density * samples.length
        first = dense.to(torch.int8).argmax(dim=1, keepdim=True)
        distance = torch.where(dense.any(dim=1), samples.s.gather(1, first)[:, 0], torch.nan)
    last = samples.edges[:, -2]
    is_hit = (rendered.opacity > LEAST_OPACITY) & (distance < last)
    return torch.where(is_hit, distance, torch.nan)


def points_on_surface(
    renderer: VolumeRenderer,
    photographs: Photographs,
    cells: Cells,
    *,
    samples: int,
    distance: Callable[[Rendered], Tensor] = distance_of,
    advance: Callable[[], object] = lambda: None,
) -> Iterator[np.ndarray]:
    """Points on the surface of a volume, for `surface_of`, of one photograph after the other.

    Of all pixels that show it. ``cells``: the proxy of the volume. ``samples``: of each path. ``distance``: as
    `distance_of`. ``advance``: called after each photograph.
    """
    box, cells, chunk = renderer.model.box, cells.to(renderer.model.place), chunk_of(renderer, samples)

    @half_the_threads()
    @torch.no_grad()
    def distances(paths: Paths) -> Tensor:
        return distance(renderer.render(paths, renderer.samples(paths, cells, samples, jitter=False)))

    some = photographs.draw(SAMPLE, box, np.random.default_rng(0)).to(renderer.model.place)
    if any(distances(some[first : first + chunk]).isfinite().any() for first in range(0, SAMPLE, chunk)):
        for view in range(len(photographs.cameras)):
            yield _of_view(renderer, photographs, view, chunk, distances)
            advance()


def _of_view(
    renderer: VolumeRenderer, photographs: Photographs, view: int, chunk: int, distances: Callable[[Paths], Tensor]
) -> np.ndarray:
    """Points of a photograph, rows of x, y, z, red, green, blue and incidence.

    ``distances`` gives those of the surface [m] along paths, NaN where there is none, for a chunk of pixels at a time.
    """
    camera, box = photographs.cameras[view], renderer.model.box
    water = photographs.water
    up = np.asarray(water.up if isinstance(water, FlatWater) else (0.0, 0.0, 1.0))
    parts = [np.zeros((0, 7))]
    pixels = photographs.pixels[view]
    for flat in np.array_split(pixels, -(-len(pixels) // chunk)) if len(pixels) else ():
        rows, columns = np.divmod(flat, camera.width)
        rgb = photographs.images[view][rows, columns]
        paths = paths_of(camera, water, np.stack([columns + 0.5, rows + 0.5], axis=-1), rgb, box, view)
        paths = paths.to(renderer.model.place)
        distance = distances(paths)
        is_hit = torch.isfinite(distance).cpu().numpy()
        points = paths.at(torch.nan_to_num(distance)[:, None])[:, 0].cpu().numpy()[is_hit].astype(np.float64)
        incidence = np.arccos(np.clip(-(paths.air.cpu().numpy()[is_hit] @ up), -1.0, 1.0))
        parts.append(np.column_stack([points, rgb[is_hit], incidence]))
    return np.concatenate(parts)


def surface_of(parts: Iterable[np.ndarray], box: Box, side: float) -> Surface:
    """Surface in cells of a side [m]: means of the points of each photograph, then over the photographs.

    In memory are the points of one photograph at a time, and for each cell sums over photographs, twice at most.
    """
    shape = tuple(np.maximum(np.ceil(box.size / side), 1).astype(int).tolist())
    of_cells = [(np.zeros((0, 9)), np.zeros(0, dtype=np.int64))]
    for part in parts:
        found = part[((part[:, :3] > box.low) & (part[:, :3] < box.high)).all(axis=1)]
        index = np.minimum(((found[:, :3] - box.low) / side).astype(int), np.array(shape) - 1)
        total, count, of_view = _sums(found - [*box.low, 0, 0, 0, 0], np.ravel_multi_index(tuple(index.T), shape))
        mean = total / count[:, None]
        of_cells.append((np.column_stack([mean, mean[:, 2] ** 2, np.ones(len(mean))]), of_view))
        if sum(len(cells) for _, cells in of_cells[1:]) > len(of_cells[0][1]):
            of_cells = [_joined(of_cells)]
    sums, _ = _joined(of_cells)
    sums = sums[sums[:, 8] >= LEAST_VIEWS]
    count = sums[:, 8]
    mean = sums[:, :7] / count[:, None]
    std = np.sqrt(np.maximum(sums[:, 7] - count * mean[:, 2] ** 2, 0.0) / (count * (count - 1)))
    return Surface(mean[:, :3] + box.low, np.round(mean[:, 3:6]).astype(np.uint8), std, count.astype(int), mean[:, 6])


def _joined(parts: list[tuple[np.ndarray, np.ndarray]]) -> tuple[np.ndarray, np.ndarray]:
    """Sums (G, C) and groups (G,) of several of them."""
    total, _, groups = _sums(*(np.concatenate(each) for each in zip(*parts, strict=True)))
    return total, groups


def _sums(values: np.ndarray, group: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Sums (G, C) of values (N, C) by group (N,), how many values each has, and the groups (G,), rising."""
    groups, inverse, count = np.unique(group, return_inverse=True, return_counts=True)
    return np.stack([np.bincount(inverse, column, len(groups)) for column in values.T], axis=-1), count, groups
