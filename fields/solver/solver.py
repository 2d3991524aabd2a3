"""Photometric least squares: heights of a survey's points and their standard deviations from all photographs."""

from collections.abc import Callable, MutableMapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from itertools import groupby, islice

import cv2
import numpy as np

from fields.solver import noise as noise_model
from fields.solver import uncertainty
from fields.solver.displacements import displacements_of, moved
from fields.solver.gauss_newton import TileSolution, shift_information
from fields.solver.moving_water import MOVING_PX, with_waves
from fields.solver.roughness import START_GSD, roughness_of, spectral_slope_of
from fields.solver.tile import SolverTile, requested_in_squares
from fields.solver.uncertainty import QUANTILE_95, SIGMAS_95
from fields.solver.views import WORKERS, TileTask, Views
from fields.solver.visibility import visibility_counts
from fields.sweep.images import gradient_of
from fields.sweep.kernels.arrays import sharing_cores
from fields.sweep.maps import HeightMap, OrderedMaps, small_sample_factor
from fields.waves.waves import Waves

# What a survey is like is learned from so many tiles of this side, spread over those that hold this share of the kept
# pixels of the fullest at least.
SAMPLES, SAMPLE_PX, LEAST_FILL = 6, 112, 0.7
# Noise alone makes one pixel in a billion as steep as this many standard deviations, or some more: its tails are long.
_SIGNIFICANT = 6.0
# Heights of the sweep come from windows of this side. Noise makes the photographs agree on nine heights that follow it
# better than on the true ones by more than this logarithm in one window of a thousand (chi-square, nine degrees).
_WINDOW_PX, _REFUTED = 3, 0.5 * 27.9
_FEWEST = 2  # Fewest photographs for a height: its own does not depend on it


@dataclass(frozen=True)
class SolvedMap:
    """Solved pixels of one height map; N of them."""

    pixels: np.ndarray  # (N,) int64: flat indices in the map, rising
    height: np.ndarray  # (N,) float32 [m] over the water plane
    std: np.ndarray  # (N,) float32 [m]: of the height, for cameras and water as they are given

    def over(self, height_map: HeightMap) -> tuple[HeightMap, np.ndarray]:
        """The map with the solved heights, and their std (height, width) [m]; NaN where nothing was solved."""
        height, std = height_map.height.copy(), np.full(height_map.height.shape, np.nan, dtype=np.float32)
        height.flat[self.pixels], std.flat[self.pixels] = self.height, self.std
        return replace(height_map, height=height), std


@dataclass(frozen=True)
class SolverFigures:
    """Parameters that the solver estimates from samples of a survey."""

    roughness_m: float  # Of the bed, from pixel to pixel: `fields.solver.roughness.roughness_of`
    shifts: noise_model.Shifts  # Between photographs: `fields.solver.noise.shifts_of`
    noise: noise_model.NoiseShares  # Variances by noise: `fields.solver.noise.noise_shares`
    spectral_slope: float  # Of the bed: `fields.solver.roughness.spectral_slope_of`
    sweep_slope_noise_ratio: float  # `fields.solver.solver.sweep_slope_noise_ratio`
    moved_px: float = 0.0  # Displacements under water, without surfaces: `fields.solver.displacements.moved`

    def __str__(self) -> str:
        return (
            f"roughness of the bed (second difference of heights): {1e3 * self.roughness_m:.1f} mm; local "
            f"shifts of single photographs (poses, waves): {self.shifts.pose_std_px:.2f} px and "
            f"{self.shifts.wave_std_px_per_m:.2f} px more for each metre of depth; variance of heights by noise, "
            f"over that of noise without correlation: {self.noise.height_variance_ratio:.2f}; power of relief: "
            f"frequency to {-2.0 * self.spectral_slope:.1f}"
        )


@dataclass(frozen=True)
class _PartSolution:
    """Solved pixels of a map, their heights, and the components of their variance; N of them."""

    pixels: np.ndarray  # (N,) int64: flat indices in the map
    height: np.ndarray  # (N,) [m] over the water plane
    noise: np.ndarray  # (N,) [m^2]: variance by noise
    relief: np.ndarray  # (N,) [m^2]: variance by relief that is smoothed away, or below the pixel
    shift: np.ndarray  # (N,) [m^2/px^2]: variance by a shift of each photograph, over that of the shift
    rise: np.ndarray  # (N,) [m/px]: slope of the bed


def solve_maps(
    views: Views,
    kept: Sequence[np.ndarray],
    figures: SolverFigures | None,
    gsd: float,
    progress: Callable[[float], None],
    make_store: Callable[[], MutableMapping[int, SolvedMap]] = dict,
) -> tuple[OrderedMaps, np.ndarray, Waves | None]:
    """Solve the kept pixels of all maps, about the heights of the sweep; some keep these (`rejects_update`).

    ``views``: with surfaces of the water where they were found before. ``kept``: sequence of (height, width) bool, as
    `fields.sweep.bed.unique_pixels` gives. ``figures``: of the survey; None only where no pixel is kept. ``gsd`` [m]:
    ground sampling distance. ``progress``: called with the share done, 0 to 1. ``make_store``: factory of the store of
    the solutions; default in memory. Returns OrderedMaps of SolvedMap, in the order of the maps; `visibility_counts` of
    all points; Waves: surfaces of the water; None where it is still.
    """
    visibility = np.zeros((2, len(views.cameras)), dtype=np.int64)
    solved, total, done = make_store(), 0, 0
    for index, wanted in enumerate(kept):
        solved[index] = SolvedMap(np.empty(0, dtype=np.int64), *np.empty((2, 0), dtype=np.float32))
        total += int(np.count_nonzero(wanted)) if views.others[index] else 0
    found = OrderedMaps(solved, list(range(len(kept))))
    if figures is None or not total:
        return found, visibility, None
    with ThreadPoolExecutor(WORKERS) as pool, sharing_cores(views.device, WORKERS):
        is_wet = views.water is not None
        moves = views.waves is not None or figures.moved_px > MOVING_PX
        if views.water is not None and views.water.n_water > 1.0 and moves:
            views = with_waves(views, kept, gsd, pool)
            places = spread(count_in_squares(views.others, kept))
            figures = figures_of(_solved_squares(views, kept, places, gsd, pool), gsd, is_wet=True)
            # What the surfaces leave of the waves is in their own variance.
            figures = replace(figures, shifts=noise_model.Shifts(figures.shifts.pose_std_px, 0.0))
        learned = figures

        def part(job: TileTask, each: TileSolution) -> tuple[_PartSolution, np.ndarray]:
            piece = _solve_part(job, views.cameras[views.views[job.index]].width, each, learned, views.waves)
            return piece, visibility_counts(each.views, each.brightness, len(views.cameras))

        jobs = (job for index, wanted in enumerate(kept) for job in views.jobs(index, wanted))
        for index, each in groupby(views.solved(jobs, figures.roughness_m, pool, part), lambda pair: pair[0].index):
            parts = []
            for job, (piece, seen) in each:
                parts.append(piece)
                visibility += seen
                done += int(np.count_nonzero(job.tile.requested))
                progress(done / total)
            solved[index] = _with_std(views.maps[index], parts, figures, is_wet)
    return found, visibility, views.waves


def count_in_squares(others: Sequence[Sequence[int]], kept: Sequence[np.ndarray]) -> list[list[int]]:
    """Kept pixels in each square of `SAMPLE_PX` of each map that has some; none of maps without overlapping others."""
    return [requested_in_squares(wanted, SAMPLE_PX) if of else [] for of, wanted in zip(others, kept, strict=True)]


def solve_sample(
    views: Views, kept: Sequence[np.ndarray], places: list[tuple[int, int]], gsd: float
) -> list[tuple[SolverTile, TileSolution]]:
    """Solved squares of a block, for `figures_of`, by their places of `spread`."""
    with ThreadPoolExecutor(WORKERS) as pool, sharing_cores(views.device, WORKERS):
        return _solved_squares(views, kept, places, gsd, pool)


def _solved_squares(
    views: Views, kept: Sequence[np.ndarray], places: list[tuple[int, int]], gsd: float, pool: Executor
) -> list[tuple[SolverTile, TileSolution]]:
    jobs = sampled(views, kept, places)
    return [each for _, each in views.solved(jobs, START_GSD * gsd, pool, lambda job, each: (job.tile, each))]


def sampled(views: Views, kept: Sequence[np.ndarray], places: list[tuple[int, int]]) -> list[TileTask]:
    """Squares by their places of `spread`."""
    return [next(islice(views.jobs(index, kept[index], SAMPLE_PX), place, None)) for index, place in places]


def figures_of(samples: list[tuple[SolverTile, TileSolution]], gsd: float, *, is_wet: bool) -> SolverFigures:
    """Parameters of a survey, estimated from solved squares of one block or of several."""
    with ThreadPoolExecutor(WORKERS) as pool:
        roughness = roughness_of(samples, gsd, pool)
    response = noise_model.median_response(samples)
    null_solutions = noise_model.null_solutions_of(samples, roughness, response)
    # Noise and shifts are confounded: first all counts as noise, then what remains without the shifts.
    all_noise = noise_model.noise_shares(null_solutions, response, noise_model.Shifts(0.0, 0.0), is_wet)
    shifts = noise_model.shifts_of(samples, all_noise.height_variance_ratio, is_wet)
    noise = noise_model.noise_shares(null_solutions, response, shifts, is_wet)
    return SolverFigures(
        roughness,
        shifts,
        noise,
        spectral_slope_of(samples, roughness, response),
        sweep_slope_noise_ratio(samples, roughness, noise),
        moved([displacements_of(tile, each, each.brightness) for tile, each in samples]) / gsd if is_wet else 0.0,
    )


def spread(filled: list[list[int]]) -> list[tuple[int, int]]:
    """Sample of the fullest squares, spread evenly over the maps: number of the map and of its square.

    ``filled`` has the pixels in the squares of each map, `count_in_squares`.
    """
    of_map = np.repeat(np.arange(len(filled)), [len(each) for each in filled])
    place, requested = (np.concatenate(each) for each in ([np.arange(len(each)) for each in filled], filled))
    full = np.flatnonzero(requested >= LEAST_FILL * requested.max())
    chosen = full[np.unique(np.linspace(0, len(full) - 1, SAMPLES).astype(int))]
    return list(zip(of_map[chosen].tolist(), place[chosen].astype(int).tolist(), strict=True))


def _solve_part(
    job: TileTask, width: int, found: TileSolution, figures: SolverFigures, waves: Waves | None
) -> _PartSolution:
    """Solution of the wanted pixels of a tile, in a map of a width, without those that keep the height of the sweep."""
    tile, noise = job.tile, figures.noise
    rows, columns = tile.places
    pixels = (rows + tile.row) * width + columns + tile.column
    of_shift = 1.0 / shift_information(found.brightness.weight, found.motion)
    expected = uncertainty.expected_variances(tile, found, noise.response, figures.spectral_slope)
    change = uncertainty.smoothing_change(found, found.height, noise.response)
    relief = uncertainty.smoothed_relief(
        tile, change, expected, noise.height_variance_ratio, noise.smoothing_variance_ratio
    )
    rise = uncertainty.local_slope(tile, found.height)
    if waves is not None:
        of_height, of_place = waves.variances(found.ground.points)
        relief += of_height + of_place * (rise / found.ground.pixel) ** 2
    relief += uncertainty.subpixel_relief(tile, found, expected, noise.height_variance_ratio, noise.excess_relief)
    by_noise = noise.height_variance_ratio * expected.noise
    values = (found.height, by_noise, relief, of_shift, rise)
    taken = tile.requested & ~rejects_update(
        tile, found, by_noise, noise, figures.sweep_slope_noise_ratio, job.tolerance
    )
    return _PartSolution(pixels[taken], *(each[taken].astype(np.float32) for each in values))


def _with_std(m: HeightMap, parts: list[_PartSolution], figures: SolverFigures, is_wet: bool) -> SolvedMap:
    """The parts of a map in the order of its pixels, with the standard deviations of their heights."""
    columns = [np.concatenate([getattr(part, each.name) for part in parts]) for each in fields(_PartSolution)]
    order = np.argsort(columns[0])
    found = _PartSolution(*(column[order] for column in columns))
    photographs = m.agreeing.flat[found.pixels] + np.float32(1.0)
    # What shifts the photographs shifts the bed in the map that shows it, too.
    shift = figures.shifts.variance(noise_model.depth_of(found.height, is_wet))
    variance = small_sample_factor(photographs) * found.noise + found.relief + shift * (found.shift + found.rise**2)
    return SolvedMap(found.pixels, found.height, np.sqrt(variance).astype(np.float32))


def rejects_update(
    tile: SolverTile,
    solved: TileSolution,
    by_noise: np.ndarray,
    noise: noise_model.NoiseShares,
    slope_noise_ratio: float,
    tolerance: float,
) -> np.ndarray:
    """Pixels (N,) bool of a solved tile that keep the height of the sweep.

    Steep ones, on walls and edges: there a pixel shows so long a piece of the bed that other photographs look
    different, and the prior alone would move its height. Their slope is above the tolerance of agreement [m], and above
    what noise makes of level ones: ``by_noise`` (N,) [m^2] is its variance in a solved height, ``slope_noise_ratio``
    that of `sweep_slope_noise_ratio`. And those about which the photographs agree better at the height of the sweep,
    by more than noise explains, or of which too few photographs keep their weight (glint).
    """
    steep = solved.start.height_slope > np.maximum(tolerance, _SIGNIFICANT * slope_noise_ratio * np.sqrt(by_noise))
    image, side = tile.image(solved.improvement), (_WINDOW_PX, _WINDOW_PX)
    window = cv2.boxFilter(image, -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)[tile.inside]
    silent = np.count_nonzero(solved.brightness.weight > 0.0, axis=0) < _FEWEST
    # Noise that neighbours share counts several times in a sum over pixels.
    return steep | silent | (window < -_REFUTED * max(noise.height_variance_ratio, 1.0))


def sweep_slope_noise_ratio(
    samples: list[tuple[SolverTile, TileSolution]], roughness: float, noise: noise_model.NoiseShares
) -> float:
    """Standard deviation of the slopes by noise of the sweep, relative to that of a solved height by noise.

    From the changes of the heights of samples by the solver, mostly noise of the sweep; walls and edges are few. A
    factor of the survey (0.9 on data/quick, 3 in blur of 4 px).
    """
    found = []
    for tile, each in samples:
        moved = tile.image(each.height - each.start.height)
        interior = cv2.erode(tile.inside.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)[tile.inside] > 0
        solved = each.with_roughness(roughness)
        by_noise = noise.height_variance_ratio * uncertainty.expected_variances(tile, solved, noise.response).noise
        found += [np.abs(rise[tile.inside][interior]) / np.sqrt(by_noise[interior]) for rise in gradient_of(moved)]
    together = np.concatenate(found)
    return float(np.quantile(together, QUANTILE_95)) / SIGMAS_95 if len(together) else 1.0
