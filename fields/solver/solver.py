"""The heights of a survey's points and their standard deviations, from all photographs at once."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import takewhile

import numpy as np

from fields.solver.roughness import START_GSD, roughness_of
from fields.solver.shares import for_few, halved, noise_share
from fields.solver.solve import Solved, parallax_of
from fields.solver.tile import Tile
from fields.solver.uncertainty import below_pixel, shift_of, variance_of
from fields.solver.views import Job, Views
from fields.sweep.block import Block
from fields.sweep.sweep import DepthMap

# What a survey is like is learned from so many tiles of this side, spread over those that are nearly as full as the
# fullest.
SAMPLES, SAMPLE_PX, NEARLY = 6, 112, 0.7
# What the variance by noise is worth, from so many tiles of this side at twice the ground sampling distance,
# spread over all of the bed, its edges too.
COARSE_SAMPLES, COARSE_PX = 10, 48
# The truth of a pixel of twice the size is the mean of four heights, unless it is a step of this many pixels.
_STEP_GSD = 10.0
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
    shift_px : float
        Between photographs: `fields.solver.uncertainty.shift_of`.
    noise_share : float
        Of the variance by noise and prior: `fields.solver.shares.noise_share`.
    """

    roughness_m: float
    shift_px: float
    noise_share: float

    def __str__(self) -> str:
        return (
            f"the bed bends by {1e3 * self.roughness_m:.1f} mm from pixel to pixel; photographs are shifted by "
            f"{self.shift_px:.2f} px against each other; the variance by noise counts {self.noise_share:.2f} times"
        )


@dataclass(frozen=True)
class _Solved:
    """Pixels of a map, their heights, and the parts of the variance [m^2]; that of a shift by one pixel last."""

    pixels: np.ndarray
    height: np.ndarray
    noise: np.ndarray
    bends: np.ndarray
    shift: np.ndarray


def solve_maps(
    block: Block,
    maps: list[DepthMap],
    kept: list[np.ndarray],
    gsd: float,
    progress: Callable[[float], None],
    goes_on: Callable[[], bool] = lambda: True,
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
    goes_on : callable
        Asked before each tile; tiles whose turn comes after it said no are left out.

    Returns
    -------
    list of SolvedMap, in the order of `maps`
    figures : SolverFigures
        NaN where nothing is kept.
    """
    views = Views.of(block, maps)
    jobs = [job for index, wanted in enumerate(kept) for job in views.jobs(index, wanted)]
    if not jobs:
        empty = np.empty(0, dtype=np.float32)
        nothing = SolvedMap(np.empty(0, dtype=np.int64), empty, empty)
        return [nothing for _ in maps], SolverFigures(np.nan, np.nan, np.nan)
    small = [job for index, wanted in enumerate(kept) for job in views.jobs(index, wanted, SAMPLE_PX)]
    total, done = sum(len(job.tile) for job in jobs), 0
    parts: list[list[_Solved]] = [[] for _ in maps]
    with ThreadPoolExecutor(_WORKERS) as pool:
        sample = _sample(small)
        first = [found for _, found in views.solved(sample, START_GSD * gsd, pool, lambda job, each: (job.tile, each))]
        roughness, noise = roughness_of(first, gsd, pool), _noise(first)
        shift = shift_of(first, roughness, pool)
        begun = takewhile(lambda _job: goes_on(), jobs)
        for job, found in views.solved(begun, roughness, pool, lambda job, each: _part(job, maps[job.index], each)):
            parts[job.index].append(found)
            done += len(job.tile)
            progress(done / total)
        joined = [_joined(each) for each in parts]
        share = _share(views, joined, noise, roughness, gsd, pool)
    solved = [_with_std(m, each, share, shift) for m, each in zip(maps, joined, strict=True)]
    return solved, SolverFigures(roughness, shift, share)


def _part(job: Job, m: DepthMap, found: Solved) -> _Solved:
    """The asked pixels of a tile."""
    tile = job.tile
    rows, columns = tile.places
    pixels = (rows + tile.row) * m.height.shape[1] + columns + tile.column
    of_shift = 1.0 / parallax_of(found.brightness.weight, found.motion)
    columns_of = (pixels, found.height, variance_of(tile, found), below_pixel(tile, found), of_shift)
    return _Solved(pixels[tile.asked], *(each[tile.asked].astype(np.float32) for each in columns_of[1:]))


def _joined(parts: list[_Solved]) -> _Solved:
    if not parts:
        empty = np.empty(0, dtype=np.float32)
        return _Solved(np.empty(0, dtype=np.int64), empty, empty, empty, empty)
    names = ("pixels", "height", "noise", "bends", "shift")
    pixels, *others = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    order = np.argsort(pixels)
    return _Solved(pixels[order], *(each[order] for each in others))


def _with_std(m: DepthMap, found: _Solved, share: float, shift: float) -> SolvedMap:
    photographs = m.agreeing.flat[found.pixels] + np.float32(1.0)
    variance = for_few(photographs) * (share * found.noise + found.bends) + shift**2 * found.shift
    return SolvedMap(found.pixels, found.height, np.sqrt(variance).astype(np.float32))


def _noise(samples: list[tuple[Tile, Solved]]) -> float:
    """Mean noise of the photographs [grey levels]."""
    return float(np.mean(np.concatenate([found.brightness.noise for _, found in samples])))


def _sample(jobs: list[Job], count: int = SAMPLES) -> list[Job]:
    """Some of the fullest tiles, spread evenly over the maps."""
    filled = np.array([int(job.tile.asked.sum()) for job in jobs])
    full = np.flatnonzero(filled >= NEARLY * filled.max())
    return [jobs[i] for i in full[np.unique(np.linspace(0, len(full) - 1, count).astype(int))]]


def _share(views: Views, joined: list[_Solved], noise: float, roughness: float, gsd: float, pool: Executor) -> float:
    """What the variance by noise is worth, from the survey at twice its ground sampling distance."""
    chosen = _spread([len(each.pixels) for each in joined], COARSE_SAMPLES)
    coarse = views.halved(sorted(set(chosen)), noise)
    jobs, truths = [], {}
    for number, index in enumerate(sorted(set(chosen))):
        truth = np.full(views.maps[index].height.shape, np.nan, dtype=np.float32)
        truth.flat[joined[index].pixels] = joined[index].height
        truths[number] = halved(truth)
        step = halved(truth**2) - truths[number] ** 2
        wanted = np.isfinite(truths[number]) & (step < (0.5 * _STEP_GSD * gsd) ** 2)
        tiles = coarse.jobs(number, wanted, COARSE_PX)
        own = _spread([int(job.tile.asked.sum()) for job in tiles], chosen.count(index))
        jobs += [tiles[i] for i in sorted(set(own))]

    def errors(job: Job, found: Solved) -> np.ndarray:
        tile = job.tile
        error = found.height - tile.of(truths[job.index])
        photographs = tile.of(coarse.maps[job.index].agreeing) + 1.0
        return np.stack([error, variance_of(tile, found), below_pixel(tile, found), photographs])[:, tile.asked]

    found = coarse.solved(jobs, 2.0 * roughness, pool, errors)
    return noise_share(*np.concatenate([np.empty((4, 0)), *(each for _, each in found)], axis=1))


def _spread(sizes: list[int], count: int) -> list[int]:
    """Which of several parts hold places that are spread evenly over all of them, in order; large ones come often."""
    ends = np.cumsum(sizes)
    if not len(ends) or ends[-1] == 0:
        return []
    return np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1], side="right").tolist()
