"""The photographs and height maps of a survey, as tiles are solved with them."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from fields.device import Device
from fields.solver.projection import Projection
from fields.solver.sight import Sight, sight_of
from fields.solver.solve import Solved, solve
from fields.solver.tile import Tile, tiles_of
from fields.sweep.block import Block
from fields.sweep.greys import Greys
from fields.sweep.sweep import DepthMap
from refract import FlatWater, PinholeCamera

Used = TypeVar("Used")

# Photographs that a tile is compared with.
MOST_VIEWS = 20
# Tiles that are solved at a time, one on each core that there may be, and those that wait for it too.
_CORES = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
WORKERS = min(_CORES, 4)
AHEAD = WORKERS + 1


@dataclass(frozen=True)
class Job:
    """A tile of a height map, and the photographs that it is compared with."""

    index: int
    tile: Tile
    others: tuple[int, ...]


@dataclass(frozen=True)
class Views:
    """What tiles are solved with.

    Attributes
    ----------
    cameras, images : of all views, by their number
    water : FlatWater or None
    device : Device
        Of the projections.
    maps : list of DepthMap
    others : list of tuple of int
        Views that each map is compared with.
    tolerance : list of float [m]
        Heights of each map that differ by less agree.
    """

    cameras: dict[int, PinholeCamera]
    images: Greys | dict[int, np.ndarray]
    water: FlatWater | None
    device: Device
    maps: list[DepthMap]
    others: list[tuple[int, ...]]
    tolerance: list[float]

    @staticmethod
    def of(block: Block, maps: list[DepthMap]) -> Views:
        """Of a block at the scale of its maps."""
        others = [tuple(block.neighbours(m.view, MOST_VIEWS)) for m in maps]
        tolerance = [
            block.agreement_tolerance(m.view, list(seen_by), float(np.median(m.height))) if seen_by else 0.0
            for m, seen_by in zip(maps, others, strict=True)
        ]
        cameras = dict(enumerate(block.cameras))
        return Views(cameras, block.images, block.water, block.device, maps, others, tolerance)

    @cached_property
    def _by_view(self) -> dict[int, DepthMap]:
        return {each.view: each for each in self.maps}

    @cached_property
    def _projection(self) -> Projection:
        return Projection(self.device, self.cameras, self.water)

    def jobs(self, index: int, wanted: np.ndarray, side: int | None = None) -> list[Job]:
        """Tiles of a map that hold all wanted pixels (height, width) bool; none where no other view overlaps."""
        if not self.others[index]:
            return []
        tiles = tiles_of(wanted, self.maps[index].agreeing > 0, side)
        return [Job(index, tile, self.others[index]) for tile in tiles]

    def solved(
        self, jobs: Iterable[Job], roughness: float, pool: Executor, use: Callable[[Job, Solved], Used]
    ) -> Iterator[tuple[Job, Used]]:
        """Solve tiles about the heights of their maps, several at a time; what ``use`` makes of each, in order.

        The kernels that see tiles in other photographs run on this thread, a few tiles ahead.
        """

        def one(job: Job, sight: Sight) -> Used:
            start = job.tile.of(self.maps[job.index].height)
            return use(job, solve(job.tile, sight, self.images, start, roughness, self.tolerance[job.index]))

        waiting: deque[tuple[Job, Future[Used]]] = deque()
        for job in jobs:
            waiting.append((job, pool.submit(one, job, self._sight(job))))
            if len(waiting) > AHEAD:
                first, found = waiting.popleft()
                yield first, found.result()
        for job, found in waiting:
            yield job, found.result()

    def _sight(self, job: Job) -> Sight:
        view, tolerance = self.maps[job.index].view, self.tolerance[job.index]
        return sight_of(job.tile, view, job.others, self.cameras, self._by_view, self._projection, tolerance)
