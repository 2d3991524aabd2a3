"""The heights of a survey's points and their standard deviations, from all photographs at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np

from fields.solver.roughness import START_GSD, roughness_of
from fields.solver.sight import sight_of
from fields.solver.solve import Solved, solve
from fields.solver.tile import Tile, tiles_of
from fields.solver.uncertainty import below_pixel, motion_of, variance_of
from fields.sweep.block import Block
from fields.sweep.sweep import DepthMap

# Photographs that a tile is compared with.
MOST_VIEWS = 20
# The roughness is learned from so many tiles of this side, spread over those that are nearly as full as the fullest.
SAMPLES, SAMPLE_PX, NEARLY = 6, 112, 0.7
_WORKERS = min(os.cpu_count() or 1, 4)


@dataclass(frozen=True)
class SolvedMap:
    """Solved pixels of one height map; N of them.

    Attributes
    ----------
    pixels : (N,) int64
        Flat indices in the map, rising.
    height : (N,) float32 [m] over the water plane
    std : (N,) float32 [m]
        Of the height, for cameras and water as they are given.
    """

    pixels: np.ndarray
    height: np.ndarray
    std: np.ndarray

    def over(self, depth_map: DepthMap) -> tuple[DepthMap, np.ndarray]:
        """The map with the solved heights, and their std (height, width) [m]; NaN where nothing was solved."""
        height, std = depth_map.height.copy(), np.full(depth_map.height.shape, np.nan, dtype=np.float32)
        height.flat[self.pixels], std.flat[self.pixels] = self.height, self.std
        return replace(depth_map, height=height), std


@dataclass(frozen=True)
class SolverFigures:
    """What the solver learned of a survey.

    Attributes
    ----------
    roughness_m : float
        Of the bed, from pixel to pixel: `fields.solver.roughness.roughness_of`.
    motion : float
        Of the variance: `fields.solver.uncertainty.motion_of`.
    """

    roughness_m: float
    motion: float

    def __str__(self) -> str:
        return (
            f"the bed bends by {1e3 * self.roughness_m:.1f} mm from pixel to pixel; photographs differ "
            f"{self.motion**0.5:.1f} times as much as by their noise"
        )


@dataclass(frozen=True)
class _Job:
    """A tile of a height map, and what it is compared with."""

    index: int
    tile: Tile
    others: list[int]
    tolerance: float


def solve_maps(
    block: Block, maps: list[DepthMap], kept: list[np.ndarray], gsd: float, progress: Callable[[float], None]
) -> tuple[list[SolvedMap], SolverFigures]:
    """Solve the kept pixels of all maps, about the heights of the sweep.

    Parameters
    ----------
    block : Block
        At the scale of the maps.
    maps : list of DepthMap
    kept : list of (height, width) bool
        As `fields.sweep.bed.unique_pixels` gives.
    gsd : [m]
        Ground sampling distance.
    progress : called with the share done, 0 to 1

    Returns
    -------
    list of SolvedMap, in the order of `maps`
    figures : SolverFigures
        NaN where nothing is kept.
    """
    by_view = {m.view: m for m in maps}

    def jobs_of(index: int, side: dict) -> list[_Job]:
        m = maps[index]
        others = block.neighbours(m.view, MOST_VIEWS)
        if not others:
            return []
        tolerance = block.agreement_tolerance(m.view, others, float(np.median(m.height)))
        tiles = tiles_of(kept[index], m.agreeing > 0, **side)
        return [_Job(index, tile, others, tolerance) for tile in tiles]

    def solved(job: _Job, roughness: float) -> tuple[Tile, Solved]:
        view, start = maps[job.index].view, job.tile.of(maps[job.index].height)
        sight = sight_of(job.tile, view, job.others, block.cameras, by_view, block.water, job.tolerance)
        return job.tile, solve(job.tile, sight, block.images, start, roughness, job.tolerance)

    small = [job for index in range(len(maps)) for job in jobs_of(index, {"side": SAMPLE_PX})]
    jobs = [job for index in range(len(maps)) for job in jobs_of(index, {})]
    if not jobs:
        empty = np.empty(0, dtype=np.float32)
        return [SolvedMap(np.empty(0, dtype=np.int64), empty, empty) for _ in maps], SolverFigures(np.nan, np.nan)
    total, done = sum(len(job.tile) for job in jobs), 0
    parts: list[list[tuple[np.ndarray, np.ndarray, np.ndarray]]] = [[] for _ in maps]
    with ThreadPoolExecutor(_WORKERS) as pool:
        first = list(pool.map(lambda job: solved(job, START_GSD * gsd), _sample(small)))
        roughness = roughness_of(first, gsd, pool)
        motion = motion_of(first, roughness, pool)

        def part(job: _Job) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
            tile, result = solved(job, roughness)
            rows, columns = tile.places
            pixels = (rows + tile.row) * maps[job.index].height.shape[1] + columns + tile.column
            std = np.sqrt(motion * variance_of(tile, result) + below_pixel(tile, result))
            return pixels[tile.asked], result.height[tile.asked], std[tile.asked].astype(np.float32)

        for job, found in zip(jobs, pool.map(part, jobs), strict=True):
            parts[job.index].append(found)
            done += len(job.tile)
            progress(done / total)
    return [_joined(each) for each in parts], SolverFigures(roughness, motion)


def _sample(jobs: list[_Job]) -> list[_Job]:
    """Some of the fullest tiles, spread evenly over the maps."""
    filled = np.array([int(job.tile.asked.sum()) for job in jobs])
    full = np.flatnonzero(filled >= NEARLY * filled.max())
    return [jobs[i] for i in full[np.unique(np.linspace(0, len(full) - 1, SAMPLES).astype(int))]]


def _joined(parts: list[tuple[np.ndarray, np.ndarray, np.ndarray]]) -> SolvedMap:
    if not parts:
        empty = np.empty(0, dtype=np.float32)
        return SolvedMap(np.empty(0, dtype=np.int64), empty, empty)
    pixels, height, std = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(pixels)
    return SolvedMap(pixels[order], height[order], std[order])
