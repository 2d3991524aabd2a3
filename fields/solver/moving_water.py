"""Surfaces of moving water in photographs, and the photographs as they would be over still water."""

from collections.abc import Iterable, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from scipy.spatial import cKDTree

from fields.image_store import GreyImages, LazyImages
from fields.solver.displacements import CELL_PX, TileDisplacements, displacements_of, moved, waves_of
from fields.solver.gauss_newton import Start
from fields.solver.tile import appearance_of, brightness_of
from fields.solver.views import WORKERS, TileTask, Views
from fields.solver.visibility import Ground, TileProjection, lookup
from fields.sweep.block import Block, downsample
from fields.sweep.kernels.arrays import host, sharing_cores
from fields.sweep.maps import HeightMap
from fields.waves.waves import Waves

# Where photographs are displaced by more under water, surfaces of it are found, in rounds until one finds no more than
# that, and so many at most, at each of two sizes.
MOVING_PX, MOST_ROUNDS = 0.1, 4
# Where they are displaced by more, windows match the wrong heights: the sweep is to see them as over still water, once
# a round finds less than half of it.
ROUGH_PX = 0.5
# Displacements are found at nodes so far apart, at the bed of every so many pixels of the maps.
_NODE_PX = 4


def with_waves(views: Views, kept: Sequence[np.ndarray], gsd: float, pool: Executor, px: float = MOVING_PX) -> Views:
    """Views with the surfaces of the water, from the kept pixels of all maps at their heights.

    Displacements are measured by linear steps: the surfaces of a round are where the next one starts. Where none are
    known, the first rounds are of photographs of half the size: steps reach twice as far, in a quarter of the time.
    ``px``: it is enough where a round finds photographs displaced by less.
    """
    still, waves = Waves.still(*views.projector.optics), views.waves
    at_half = [] if waves is not None else [(*_halved(views, kept), 2.0 * gsd, MOVING_PX)]
    for seen, wanted_in, pixel, enough_px in (*at_half, (views, kept, gsd, px)):
        for number in range(MOST_ROUNDS):
            seen = replace(seen, waves=waves)
            jobs = (job for index, wanted in enumerate(wanted_in) for job in seen.jobs(index, wanted))
            parts = [found for found in _measured(seen, jobs, pool) if len(found.cell)]
            if not parts:
                break
            is_last = number + 1 == MOST_ROUNDS or moved(parts) < enough_px * pixel
            waves = waves_of(parts, still, CELL_PX * pixel, waves, is_last=is_last)
            if is_last:
                break
    return replace(views, waves=waves)


def _halved(views: Views, kept: Sequence[np.ndarray]) -> tuple[Views, list[np.ndarray]]:
    """Views and kept pixels at half size."""
    cameras = {view: camera.scaled(0.5) for view, camera in views.cameras.items()}
    images = (np.rint(downsample(views.images[view], (each.width, each.height))) for view, each in cameras.items())

    def half(number: int) -> Any:
        m = views.maps[number]
        return HeightMap(m.view, *(each[1::2, 1::2] for each in (m.height, m.score, m.agreeing, m.spread)))

    maps = LazyImages(half, len(views.maps), (cameras[0].height, cameras[0].width))
    halved = replace(views, cameras=cameras, images=GreyImages(images, of_one_size=False), maps=maps)
    return halved, [wanted[1::2, 1::2] for wanted in kept]


def _measured(views: Views, jobs: Iterable[TileTask], pool: Executor) -> Iterable[TileDisplacements]:
    """Displacements in tiles at the heights of their maps, against those by the surfaces of the views."""

    def one(job: TileTask, projected: TileProjection, _start: Start) -> TileDisplacements:
        grey = projected.sample(views.images, np.zeros(len(job.tile), dtype=np.float32))
        return displacements_of(job.tile, projected, brightness_of(appearance_of(job.tile, grey).albedo(grey)))

    return (found for _, found in views.projected(jobs, pool, one))


def without_waves(
    block: Block, views: Views, kept: Sequence[np.ndarray], sample: Iterable[TileTask], gsd: float
) -> tuple[Block, Waves, float] | None:
    """Photographs as they would be over still water, the surfaces, and how far these displace them [px].

    None where a sample of tiles shows no rough water: `ROUGH_PX`.
    """
    with ThreadPoolExecutor(WORKERS) as pool, sharing_cores(block.device, WORKERS):
        moved_px = moved(list(_measured(views, sample, pool))) / gsd
        if moved_px < ROUGH_PX:
            return None
        views = with_waves(views, kept, gsd, pool, 0.5 * ROUGH_PX)
    if views.waves is None:
        return None
    bed = bed_of(views, kept)
    still = (still_photograph(views, views.waves, view, bed) for view in range(len(block.cameras)))
    return block.with_images(GreyImages(still, of_one_size=False)), views.waves, moved_px


def bed_of(views: Views, kept: Sequence[np.ndarray]) -> np.ndarray:
    """Points (N, 3) of the bed, in the frame of the water."""
    parts = []
    for m, wanted in zip(views.maps, kept, strict=True):
        row, column = (each * _NODE_PX for each in np.nonzero(wanted[::_NODE_PX, ::_NODE_PX]))
        points = views.projector.points(m.view, np.stack([column, row], axis=-1) + 0.5, m.height[row, column])
        parts.append(np.stack([host(views.device, each) for each in points], axis=-1))
    return np.concatenate(parts)


def still_photograph(views: Views, waves: Waves, view: int, bed: np.ndarray) -> np.ndarray:
    """A photograph (height, width) as it would be over still water, in whole grey levels; NaN where not known."""
    camera, tree = views.cameras[view], cKDTree(bed[:, :2])
    rows, columns = -(-camera.height // _NODE_PX), -(-camera.width // _NODE_PX)
    down, across = np.mgrid[:rows, :columns].reshape(2, -1) * _NODE_PX + 0.5 * _NODE_PX
    pixels, height = np.stack([across, down], axis=-1), np.full(rows * columns, np.median(bed[:, 2]))
    places = np.concatenate([pixels, pixels, *(pixels + step for step in np.eye(2))])
    for _ in range(2):
        found = views.projector.points(view, places, np.tile(height, 4))
        points = np.stack([host(views.device, each) for each in found]).reshape(3, 4, -1)
        height = bed[tree.query(points[:2, 0].T)[1], 2]
    ground = Ground.of(points)
    shift = ground.in_pixels(waves.displacement(view, ground.points)).reshape(2, rows, columns).astype(np.float32)
    size = columns * _NODE_PX, rows * _NODE_PX
    x, y = (cv2.resize(each, size)[: camera.height, : camera.width] for each in shift)
    row, column = np.mgrid[: camera.height, : camera.width].astype(np.float32) + np.float32(0.5)
    still = lookup(views.images[view], (column + x).ravel(), (row + y).ravel(), cv2.INTER_CUBIC)
    return np.rint(still).reshape(camera.height, camera.width)
