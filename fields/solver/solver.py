"""The heights of a survey's points and their standard deviations, from all photographs at once."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import takewhile

import numpy as np

from fields.solver.correlation import NoiseShares, noise_shares, phantoms_of, response_of
from fields.solver.roughness import START_GSD, roughness_of
from fields.solver.shifts import Shifts, depth_of, shifts_of
from fields.solver.sightings import Sightings
from fields.solver.solve import Solved, parallax_of
from fields.solver.uncertainty import bends_below, change_of, expected_of, relief_of, rise_of
from fields.solver.views import WORKERS, Job, Views
from fields.sweep.block import Block
from fields.sweep.certainty import for_few
from fields.sweep.sweep import DepthMap

# What a survey is like is learned from so many tiles of this side, spread over those that are nearly as full as the
# fullest.
SAMPLES, SAMPLE_PX, NEARLY = 6, 112, 0.7


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
    shifts : Shifts
        Between photographs: `fields.solver.shifts.shifts_of`.
    noise : NoiseShares
        What noise is worth: `fields.solver.correlation.noise_shares`.
    sightings : Sightings or None
        Of all points in all photographs; None where nothing was solved.
    """

    roughness_m: float
    shifts: Shifts
    noise: NoiseShares
    sightings: Sightings | None = field(default=None, compare=False)

    def __str__(self) -> str:
        return (
            f"the bed bends by {1e3 * self.roughness_m:.1f} mm from pixel to pixel; photographs are shifted against "
            f"each other by {self.shifts.anywhere_px:.2f} px and {self.shifts.by_depth_px_m:.2f} px for each metre of "
            f"water; the variance by noise counts {self.noise.heights:.2f} times"
        )


@dataclass(frozen=True)
class _Solved:
    """Pixels of a map, their heights, and what their variance consists of.

    The variance by noise and by relief that is smoothed away or below the pixel [m^2], that of a shift of each
    photograph by one pixel, and the rise of the bed from pixel to pixel [m].
    """

    pixels: np.ndarray
    height: np.ndarray
    noise: np.ndarray
    relief: np.ndarray
    shift: np.ndarray
    rise: np.ndarray


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
        unknown = SolverFigures(np.nan, Shifts(np.nan, np.nan), NoiseShares(np.nan, np.nan, np.nan))
        return [nothing for _ in maps], unknown
    small = [job for index, wanted in enumerate(kept) for job in views.jobs(index, wanted, SAMPLE_PX)]
    total, done, is_wet = sum(len(job.tile) for job in jobs), 0, block.water is not None
    parts: list[list[_Solved]] = [[] for _ in maps]
    with ThreadPoolExecutor(WORKERS) as pool:
        sample = _sample(small)
        first = [found for _, found in views.solved(sample, START_GSD * gsd, pool, lambda job, each: (job.tile, each))]
        roughness, response = roughness_of(first, gsd, pool), response_of(first)
        phantoms = phantoms_of(first, roughness, response)
        noise = noise_shares(phantoms, response, Shifts(0.0, 0.0), is_wet)
        shifts = shifts_of(first, noise.heights, is_wet)
        noise = noise_shares(phantoms, response, shifts, is_wet)
        sightings = Sightings.none(len(block.images))

        def part(job: Job, each: Solved) -> tuple[_Solved, Sightings]:
            return _part(job, maps[job.index], each, noise), Sightings.of(each, len(block.images))

        begun = takewhile(lambda _job: goes_on(), jobs)
        for job, (found, seen) in views.solved(begun, roughness, pool, part):
            parts[job.index].append(found)
            sightings += seen
            done += len(job.tile)
            progress(done / total)
    figures = SolverFigures(roughness, shifts, noise, sightings)
    return [_with_std(m, _joined(each), figures, is_wet) for m, each in zip(maps, parts, strict=True)], figures


def _part(job: Job, m: DepthMap, found: Solved, noise: NoiseShares) -> _Solved:
    """The asked pixels of a tile."""
    tile = job.tile
    rows, columns = tile.places
    pixels = (rows + tile.row) * m.height.shape[1] + columns + tile.column
    of_shift = 1.0 / parallax_of(found.brightness.weight, found.motion)
    expected = expected_of(tile, found, noise.response)
    change = change_of(found, found.height, noise.response)
    relief = relief_of(tile, change, expected, noise.heights, noise.changes) + bends_below(found)
    values = (found.height, noise.heights * expected.noise, relief, of_shift, rise_of(tile, found.height))
    return _Solved(pixels[tile.asked], *(each[tile.asked].astype(np.float32) for each in values))


def _joined(parts: list[_Solved]) -> _Solved:
    if not parts:
        empty = np.empty(0, dtype=np.float32)
        return _Solved(np.empty(0, dtype=np.int64), empty, empty, empty, empty, empty)
    names = ("pixels", "height", "noise", "relief", "shift", "rise")
    pixels, *others = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    order = np.argsort(pixels)
    return _Solved(pixels[order], *(each[order] for each in others))


def _with_std(m: DepthMap, found: _Solved, figures: SolverFigures, is_wet: bool) -> SolvedMap:
    photographs = m.agreeing.flat[found.pixels] + np.float32(1.0)
    # What shifts the photographs shifts the bed in the map that shows it, too.
    shift = figures.shifts.variance(depth_of(found.height, is_wet))
    variance = for_few(photographs) * found.noise + found.relief + shift * (found.shift + found.rise**2)
    return SolvedMap(found.pixels, found.height, np.sqrt(variance).astype(np.float32))


def _sample(jobs: list[Job], count: int = SAMPLES) -> list[Job]:
    """Some of the fullest tiles, spread evenly over the maps."""
    filled = np.array([int(job.tile.asked.sum()) for job in jobs])
    full = np.flatnonzero(filled >= NEARLY * filled.max())
    return [jobs[i] for i in full[np.unique(np.linspace(0, len(full) - 1, count).astype(int))]]
