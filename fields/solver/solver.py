"""The heights of a survey's points and their standard deviations, from all photographs at once."""

from __future__ import annotations

from collections.abc import Callable, MutableMapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from itertools import groupby, islice, takewhile

import numpy as np

from fields.solver.choosing import keeps_sweep, slopes_by_noise
from fields.solver.correlation import NoiseShares, noise_shares, phantoms_of, response_of
from fields.solver.fall import fall_of
from fields.solver.roughness import START_GSD, roughness_of
from fields.solver.shifts import Shifts, depth_of, shifts_of
from fields.solver.sightings import Sightings
from fields.solver.solve import Solved, parallax_of
from fields.solver.tile import Tile, asked_in_squares
from fields.solver.uncertainty import bends_below, change_of, expected_of, relief_of, rise_of
from fields.solver.views import WORKERS, Job, Views
from fields.sweep.block import Block
from fields.sweep.height_std import small_sample_factor
from fields.sweep.kernels.arrays import sharing_cores
from fields.sweep.maps import DepthMap, OrderedMaps

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

    @staticmethod
    def empty() -> SolvedMap:
        """That of a map of which nothing was solved."""
        nothing = np.empty(0, dtype=np.float32)
        return SolvedMap(np.empty(0, dtype=np.int64), nothing, nothing)

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
    fall : float
        How steeply the bed's power falls with the frequency: `fields.solver.fall.fall_of`.
    slopes : float
        Of the noise of the sweep: `fields.solver.choosing.slopes_by_noise`.
    sightings : Sightings or None
        Of all points in all photographs; None where nothing was solved.
    """

    roughness_m: float
    shifts: Shifts
    noise: NoiseShares
    fall: float
    slopes: float
    sightings: Sightings | None = field(default=None, compare=False)

    def __str__(self) -> str:
        return (
            f"roughness of the bed, as the bend from one pixel to the next: {1e3 * self.roughness_m:.1f} mm; local "
            f"shifts of single photographs (poses, waves): {self.shifts.anywhere_px:.2f} px and "
            f"{self.shifts.by_depth_px_m:.2f} px more for each metre of depth; variance of heights by noise, over that "
            f"of noise without correlation: {self.noise.heights:.2f}; power of relief: frequency to "
            f"{-2.0 * self.fall:.1f}"
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
    maps: Sequence[DepthMap],
    kept: Sequence[np.ndarray],
    gsd: float,
    progress: Callable[[float], None],
    goes_on: Callable[[], bool] = lambda: True,
    keep: Callable[[], MutableMapping[int, SolvedMap]] = dict,
) -> tuple[OrderedMaps, SolverFigures]:
    """Solve the kept pixels of all maps, about the heights of the sweep; some keep these (`choosing.keeps_sweep`).

    Parameters
    ----------
    block : Block
        At the scale of the maps.
    maps : sequence of DepthMap
    kept : sequence of (height, width) bool
        As `fields.sweep.bed.unique_pixels` gives.
    gsd : [m]
        Ground sampling distance.
    progress : called with the share done, 0 to 1
    goes_on : callable
        Asked before each tile; tiles whose turn comes after it said no are left out.
    keep : callable
        Makes the place in which what is solved is kept; default in memory.

    Returns
    -------
    InOrder of SolvedMap, in the order of `maps`
    figures : SolverFigures
        NaN where nothing is kept.
    """
    views = Views.of(block, maps)
    filled = [asked_in_squares(wanted, SAMPLE_PX) if views.others[index] else [] for index, wanted in enumerate(kept)]
    total, done = sum(map(sum, filled)), 0
    solved = keep()
    for index in range(len(filled)):
        solved[index] = SolvedMap.empty()
    found = OrderedMaps(solved, list(range(len(filled))))
    if not total:
        return found, SolverFigures(np.nan, Shifts(np.nan, np.nan), NoiseShares(*4 * (np.nan,)), np.nan, np.nan)
    with ThreadPoolExecutor(WORKERS) as pool, sharing_cores(block.device, WORKERS):
        sample = _sample(views, kept, filled)
        first = [each for _, each in views.solved(sample, START_GSD * gsd, pool, lambda job, each: (job.tile, each))]
        is_wet = block.water is not None
        figures = _learned(first, gsd, pool, is_wet)
        sightings = Sightings.none(len(block.images))

        def part(job: Job, each: Solved) -> tuple[_Solved, Sightings]:
            return _part(job, block.cameras[0].width, each, figures), Sightings.of(each, len(block.images))

        jobs = (job for index, wanted in enumerate(kept) for job in views.jobs(index, wanted))
        begun = takewhile(lambda _job: goes_on(), jobs)
        for index, each in groupby(views.solved(begun, figures.roughness_m, pool, part), lambda pair: pair[0].index):
            parts = []
            for job, (piece, seen) in each:
                parts.append(piece)
                sightings += seen
                done += int(np.count_nonzero(job.tile.asked))
                progress(done / total)
            solved[index] = _with_std(maps[index], _joined(parts), figures, is_wet)
    return found, replace(figures, sightings=sightings)


def _learned(samples: list[tuple[Tile, Solved]], gsd: float, pool: Executor, is_wet: bool) -> SolverFigures:
    """What solved samples tell of the survey."""
    roughness, response = roughness_of(samples, gsd, pool), response_of(samples)
    phantoms = phantoms_of(samples, roughness, response)
    # Noise looks like shifts, and shifts like noise: first all is noise, then what shifts leave.
    all_noise = noise_shares(phantoms, response, Shifts(0.0, 0.0), is_wet)
    shifts = shifts_of(samples, all_noise.heights, is_wet)
    noise = noise_shares(phantoms, response, shifts, is_wet)
    return SolverFigures(
        roughness, shifts, noise, fall_of(samples, roughness, response), slopes_by_noise(samples, roughness, noise)
    )


def _part(job: Job, width: int, found: Solved, figures: SolverFigures) -> _Solved:
    """The asked pixels of a tile, of a map of a width, but for those that keep the height of the sweep."""
    tile, noise = job.tile, figures.noise
    rows, columns = tile.places
    pixels = (rows + tile.row) * width + columns + tile.column
    of_shift = 1.0 / parallax_of(found.brightness.weight, found.motion)
    expected = expected_of(tile, found, noise.response, figures.fall)
    change = change_of(found, found.height, noise.response)
    relief = relief_of(tile, change, expected, noise.heights, noise.changes)
    relief += bends_below(found, expected, noise.heights, noise.unfollowed)
    by_noise = noise.heights * expected.noise
    values = (found.height, by_noise, relief, of_shift, rise_of(tile, found.height))
    taken = tile.asked & ~keeps_sweep(tile, found, by_noise, noise, figures.slopes, job.tolerance)
    return _Solved(pixels[taken], *(each[taken].astype(np.float32) for each in values))


def _joined(parts: list[_Solved]) -> _Solved:
    names = ("pixels", "height", "noise", "relief", "shift", "rise")
    pixels, *others = (np.concatenate([getattr(part, name) for part in parts]) for name in names)
    order = np.argsort(pixels)
    return _Solved(pixels[order], *(each[order] for each in others))


def _with_std(m: DepthMap, found: _Solved, figures: SolverFigures, is_wet: bool) -> SolvedMap:
    photographs = m.agreeing.flat[found.pixels] + np.float32(1.0)
    # What shifts the photographs shifts the bed in the map that shows it, too.
    shift = figures.shifts.variance(depth_of(found.height, is_wet))
    variance = small_sample_factor(photographs) * found.noise + found.relief + shift * (found.shift + found.rise**2)
    return SolvedMap(found.pixels, found.height, np.sqrt(variance).astype(np.float32))


def _sample(views: Views, kept: Sequence[np.ndarray], filled: list[list[int]]) -> list[Job]:
    """Some of the fullest tiles, spread evenly over the maps; ``filled`` has what is asked for in all tiles of each."""
    of_map = np.repeat(np.arange(len(filled)), [len(each) for each in filled])
    place, asked = (np.concatenate(each) for each in ([np.arange(len(each)) for each in filled], filled))
    full = np.flatnonzero(asked >= NEARLY * asked.max())
    chosen = full[np.unique(np.linspace(0, len(full) - 1, SAMPLES).astype(int))]
    return [
        next(islice(views.jobs(index, kept[index], SAMPLE_PX), int(place[i]), None))
        for i, index in zip(chosen, of_map[chosen].tolist(), strict=True)
    ]
