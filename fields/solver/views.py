"""The photographs and height maps of a survey, as tiles are solved with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fields.solver.sight import sight_of
from fields.solver.solve import Solved, solve
from fields.solver.tile import TILE_PX, Tile, tiles_of
from fields.sweep.block import Block
from fields.sweep.sweep import DepthMap
from refract import FlatWater, PinholeCamera

# Photographs that a tile is compared with.
MOST_VIEWS = 20


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
    maps : list of DepthMap
    others : list of tuple of int
        Views that each map is compared with.
    tolerance : list of float [m]
        Heights of each map that differ by less agree.
    """

    cameras: dict[int, PinholeCamera]
    images: dict[int, np.ndarray]
    water: FlatWater | None
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
        cameras, images = dict(enumerate(block.cameras)), dict(enumerate(block.images))
        return Views(cameras, images, block.water, maps, others, tolerance)

    def jobs(self, index: int, wanted: np.ndarray, side: int = TILE_PX) -> list[Job]:
        """Tiles of a map that hold all wanted pixels (height, width) bool; none where no other view overlaps."""
        if not self.others[index]:
            return []
        tiles = tiles_of(wanted, self.maps[index].agreeing > 0, side)
        return [Job(index, tile, self.others[index]) for tile in tiles]

    def solved(self, job: Job, roughness: float) -> Solved:
        """Solve a tile about the heights of its map."""
        m, tolerance = self.maps[job.index], self.tolerance[job.index]
        by_view = {each.view: each for each in self.maps}
        sight = sight_of(job.tile, m.view, list(job.others), self.cameras, by_view, self.water, tolerance)
        return solve(job.tile, sight, self.images, job.tile.of(m.height), roughness, tolerance)
