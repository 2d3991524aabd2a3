"""Photographs and height maps that tiles are solved with, and the queue of tiles."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np

from fields.device import Device
from fields.image_store import GreyImages, num_cached
from fields.solver.gauss_newton import Start, TileSolution, solve
from fields.solver.tile import MOST_PX, SolverTile, tiles_of
from fields.solver.visibility import DisplacementImage, Occluder, Projector, TileProjection, project_tiles
from fields.sweep.block import Block
from fields.sweep.maps import HeightMap
from fields.waves.waves import Waves
from refract import FlatWater, PinholeCamera

Used = TypeVar("Used")

MOST_VIEWS = 20  # Photographs that a tile is compared with
_KEPT_BYTES, _OCCLUDER_BYTES = 200_000_000, 5  # Occluders that are kept, in bytes of so many a pixel
# Tiles that are solved at a time, one on each core that there may be, and pixels of those that wait for it too.
_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
WORKERS = min(_CORES, 4)
AHEAD_PX = 2 * MOST_PX


@dataclass(frozen=True)
class TileTask:
    """Tile of a height map and the photographs that it is compared with."""

    index: int  # Of the map
    tile: SolverTile
    others: tuple[int, ...]
    tolerance: float  # [m]: heights of the map that differ by less agree


@dataclass(frozen=True)
class Views:
    """Photographs, cameras, water and height maps that tiles are solved with."""

    # cameras, images: of all views, by their number
    cameras: dict[int, PinholeCamera]
    images: GreyImages | dict[int, np.ndarray]
    water: FlatWater | None
    device: Device  # Of the projections
    maps: Sequence[HeightMap]
    views: list[int]  # Those of the maps
    others: list[tuple[int, ...]]  # list of tuple of int: views that each map is compared with
    tolerance: list[float]  # [m]: heights of each map that differ by less agree
    waves: Waves | None = None  # Surfaces of the water, where it is not still

    @staticmethod
    def of(block: Block, maps: Sequence[HeightMap], waves: Waves | None = None) -> Views:
        """Views of a block at the scale of its maps."""
        views, others, tolerance = [], [], []
        for m in maps:
            seen_by = block.neighbours(m.view, MOST_VIEWS)
            views.append(m.view)
            others.append(tuple(seen_by))
            height = float(np.median(m.height))
            tolerance.append(block.agreement_tolerance(m.view, seen_by, height) if seen_by else 0.0)
        cameras = dict(enumerate(block.cameras))
        return Views(cameras, block.images, block.water, block.device, maps, views, others, tolerance, waves)

    @cached_property
    def _occluder(self) -> Callable[[int], Any]:
        """`Occluder` of a view, None without a map; the last few are kept, so that each is read a few times only."""
        maps = self.maps  # not the views: a cache that holds them would live until the garbage collector finds both
        size = maps[0].height.size if len(maps) else 0
        number = {view: number for number, view in enumerate(self.views)}

        @lru_cache(num_cached(_OCCLUDER_BYTES * size, _KEPT_BYTES, MOST_VIEWS + 1))
        def occluder(view: int) -> Occluder:
            m = maps[number[view]]
            return Occluder(m.height, m.agreeing > 0)

        return lambda view: occluder(view) if view in number else None

    @cached_property
    def _by_waves(self) -> Callable[[int], DisplacementImage] | None:
        """`DisplacementImage` of a view, None over still water; the last few are kept."""
        if self.waves is None:
            return None
        waves, projector = self.waves, self.projector

        @lru_cache(MOST_VIEWS + 1)
        def displacements(view: int) -> DisplacementImage:
            return DisplacementImage.of(view, projector, waves)

        return displacements

    @cached_property
    def projector(self) -> Projector:
        return Projector(self.device, self.cameras, self.water)

    def jobs(self, index: int, wanted: np.ndarray, side: int | None = None) -> Iterator[TileTask]:
        """Tiles of a map that hold all wanted pixels (height, width) bool; none where no other view overlaps."""
        if self.others[index] and wanted.any():
            for tile in tiles_of(wanted, self.maps[index].agreeing > 0, side):
                yield TileTask(index, tile, self.others[index], self.tolerance[index])

    def solved(
        self, jobs: Iterable[TileTask], roughness: float, pool: Executor, use: Callable[[TileTask, TileSolution], Used]
    ) -> Iterator[tuple[TileTask, Used]]:
        """Solve tiles about the heights of their maps; yields ``use`` of each, in order."""

        def one(job: TileTask, projected: TileProjection, start: Start) -> Used:
            return use(job, solve(job.tile, projected, self.images, start, roughness, job.tolerance))

        return self.projected(jobs, pool, one)

    def projected(
        self, jobs: Iterable[TileTask], pool: Executor, one: Callable[[TileTask, TileProjection, Start], Used]
    ) -> Iterator[tuple[TileTask, Used]]:
        """Project tiles at the heights of their maps; yields ``one`` of each, several at a time, in order.

        The kernels that see tiles in other photographs run on this thread, a few tiles ahead.
        """
        waiting: deque[tuple[TileTask, Future[Used]]] = deque()
        pixels = 0
        for batch in _batches(jobs):
            view, tolerance, tiles = self.views[batch[0].index], batch[0].tolerance, [job.tile for job in batch]
            views, occluder = [view, *batch[0].others], self._occluder
            together = project_tiles(tiles, views, occluder, self.projector, tolerance, self._by_waves)
            for job, projected in zip(batch, together, strict=True):
                start = Start.of(job.tile, occluder(view).height)
                waiting.append((job, pool.submit(one, job, projected, start)))
                pixels += len(job.tile)
            while pixels > AHEAD_PX:
                first, found = waiting.popleft()
                pixels -= len(first.tile)
                yield first, found.result()
        for job, found in waiting:
            yield job, found.result()


def _batches(jobs: Iterable[TileTask]) -> Iterator[list[TileTask]]:
    """Jobs of one map each, of `MOST_PX` pixels together at most, except where one has more."""
    batch: list[TileTask] = []
    for job in jobs:
        if batch and (job.index != batch[0].index or sum(len(each.tile) for each in (*batch, job)) > MOST_PX):
            yield batch
            batch = []
        batch.append(job)
    if batch:
        yield batch
