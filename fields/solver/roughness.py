"""Roughness of the bed and the slope of its spectrum, learned from solved tiles.

The roughness is found by cross-validation: half of the photographs predict the other half.

The prior takes from the bed what is as fine as noise, or finer. How much that is follows from what smoothing the
heights once more changes only if the power of the bed at small scale against that at large scale is known: the slope
of the spectrum. Smoothing that change once more shows it: the rougher the bed at small scale, the more changes. Both
are made with the normal matrix itself, whose information differs from pixel to pixel, so that a uniform one is wrong
for both alike.
"""

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np

from fields.solver import gauss_newton, uncertainty
from fields.solver.noise import null_solution_of
from fields.solver.tile import SolverTile

# The search starts at this share of the ground sampling distance and goes in steps of this factor, this far at most.
START_GSD, FACTOR, MOST_STEPS = 0.5, np.sqrt(2.0), 6
_ROUNDS = 3  # Iterations of the stiffness
_BLOCK_PX = 16  # Errors within one such block are correlated
TRIM = 0.1  # Share of the blocks left out at either end: steps and edges would decide for all of the bed
# Exponents that beds may have, and how far they differ from that of the prior.
_SPECTRAL_SLOPES, _BEDS_DIFFER = np.linspace(0.5, 1.5, 21), 0.25
_NOISE_KNOWN = 0.03  # Null solutions have the noise of changes to this share of it, besides chance
_LEAST_PIXELS = 2000  # Fewest pixels


@dataclass(frozen=True)
class Half:
    """Quadratic cost of the heights of a tile by half of the photographs, about the solution by all.

    The sum of their squared residuals, for changes d (N,) [m], is ``sum(information * d * d + 2 * gradient * d)`` more.
    """

    information: np.ndarray
    gradient: np.ndarray

    def cost(self, change: np.ndarray) -> np.ndarray:
        """Increase (N,) of the squared residuals, in units of their variance."""
        return self.information * change * change + 2.0 * self.gradient * change


def split_halves(solved: gauss_newton.TileSolution) -> tuple[Half, Half]:
    """Costs by every other photograph and by the rest, each with an albedo of its own."""
    found = []
    for first in (0, 1):
        weight = solved.brightness.weight[first::2]
        total = np.maximum(weight.sum(axis=0), 1e-12)
        residual, by_height = (
            np.where(weight > 0.0, part - np.einsum("kn,kn->n", weight, part) / total, np.float32(0.0))
            for part in (solved.brightness.residual[first::2], solved.residual_by_height[first::2])
        )
        information = np.einsum("kn,kn,kn->n", weight, by_height, by_height)
        gradient = np.einsum("kn,kn,kn->n", weight, by_height, residual)
        found.append(Half(information, gradient))
    return found[0], found[1]


def heights_from_half(solved: gauss_newton.TileSolution, half: Half, roughness: float) -> np.ndarray:
    """Heights (N,) [m] from half of the photographs, linearised about those of all."""
    height = solved.height
    for number in range(_ROUNDS):
        stiffness = gauss_newton.stiffness_of(solved.differences.matrix @ height, roughness)
        right = half.information * (solved.height - height) - half.gradient
        right -= solved.differences.gradient(stiffness, height)
        residual = gauss_newton.CG_RESIDUAL if number + 1 == _ROUNDS else gauss_newton.CG_RESIDUAL_BEFORE
        height = height + solved.differences.solve(half.information, stiffness, right, residual)
    return height


def roughness_of(samples: list[tuple[SolverTile, gauss_newton.TileSolution]], gsd: float, pool: Executor) -> float:
    """Roughness [m] with which each half of the photographs predicts the other best.

    Of those that are worse by less than one standard error the smoothest is taken, as is usual in cross-validation.
    Where that is the best itself, it is the least of a parabola through the best and its neighbours, so that the scale
    does not jump by a step where two of them are as good. ``samples``: tiles that were solved with `START_GSD` times
    the ground sampling distance. ``gsd`` [m]: ground sampling distance. ``pool``: solves the samples side by side.
    """
    split = [(tile, solved, split_halves(solved)) for tile, solved in samples]
    known: dict[int, np.ndarray] = {}

    def cost(step: int) -> np.ndarray:
        """Prediction errors of each half by the other, summed over blocks of pixels."""
        if step not in known:
            roughness = START_GSD * gsd * FACTOR**step

            def errors(tile: SolverTile, solved: gauss_newton.TileSolution, halves: tuple[Half, Half]) -> np.ndarray:
                total = sum(
                    other.cost(heights_from_half(solved, half, roughness) - solved.height)
                    for half, other in (halves, halves[::-1])
                )
                rows, columns = (index // _BLOCK_PX for index in tile.places)
                block, number = np.unique(rows * 1000 + columns, return_inverse=True)
                return np.bincount(number, np.where(tile.requested, total, 0.0), len(block))

            known[step] = np.concatenate(list(pool.map(lambda each: errors(*each), split)))
        return known[step]

    best = 0
    for direction in (1, -1):
        while abs(best + direction) <= MOST_STEPS and _trimmed_mean(cost(best + direction) - cost(best)) < 0.0:
            best += direction
    found = best
    while best > -MOST_STEPS:
        difference = cost(best - 1) - cost(found)
        inner = np.clip(difference, *np.quantile(difference, (TRIM, 1.0 - TRIM)))
        if _trimmed_mean(difference) > inner.std() / ((1.0 - 2.0 * TRIM) * np.sqrt(len(difference))):
            break
        best -= 1
    between = 0.0
    if best == found and abs(found) < MOST_STEPS:
        # The vertex of the parabola through zero at the best and the values one step below and above it.
        below, above = (_trimmed_mean(cost(found + direction) - cost(found)) for direction in (-1, 1))
        between = 0.5 * (below - above) / (below + above) if below + above > 0.0 else 0.0
    return float(START_GSD * gsd * FACTOR ** (best + between))


def _trimmed_mean(values: np.ndarray) -> float:
    """Trimmed mean; scipy.stats has it, and takes half a second to import."""
    out = int(TRIM * len(values))
    return float(np.sort(values)[out : len(values) - out].mean())


def spectral_slope_of(
    samples: list[tuple[SolverTile, gauss_newton.TileSolution]], roughness: float, response: float
) -> float:
    """Spectral slope of the bed: the exponent of its power over frequency in `fields.solver.uncertainty`.

    ``samples``: solved tiles, with the stiffness of any roughness. ``roughness`` [m]: with which the survey is solved.
    ``response``: median gradient response, `fields.solver.noise.median_response`.
    """
    parts = []
    for tile, each in samples:
        solved = each.with_roughness(roughness)
        _, null_solution, known = null_solution_of(solved, response)
        use = known & tile.requested
        squares = []
        for heights in (solved.height + uncertainty.residual_step(solved, response)[1], null_solution):
            once = uncertainty.smoothing_change(solved, heights, response)
            squares.append(np.square([once, uncertainty.smoothing_change(solved, once, response)])[:, use])
        parts.append((*squares, uncertainty.effective_information(tile, solved, response)[1][use]))
    # (2, N) [m^2]: squared changes by smoothing once more, and of these by smoothing them in turn.
    bed, noise, log_ratio = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    if len(log_ratio) < _LEAST_PIXELS:
        return uncertainty.PRIOR_SPECTRAL_SLOPE
    # Steps and edges do not move the rest.
    power, by_noise = (np.quantile(each, uncertainty.ONE_STD, axis=-1) for each in (bed, noise))
    middle = float(np.median(log_ratio))
    correlated_px = uncertainty.spectral_means(middle, uncertainty.PRIOR_SPECTRAL_SLOPE).correlated_px
    chance = np.sqrt(2.0 * correlated_px / len(log_ratio))
    known = np.hypot(chance * power, np.hypot(chance, _NOISE_KNOWN) * by_noise)
    residual, costs = (power - by_noise) / known, []
    for spectral_slope in _SPECTRAL_SLOPES:
        means = uncertainty.spectral_means(middle, float(spectral_slope))
        relief = np.array([means.changed_relief, means.twice_changed_relief]) / known
        size = max(float(relief @ residual / (relief @ relief)), 0.0)
        misfit = residual - size * relief
        costs.append(misfit @ misfit + ((spectral_slope - uncertainty.PRIOR_SPECTRAL_SLOPE) / _BEDS_DIFFER) ** 2)
    return float(_SPECTRAL_SLOPES[int(np.argmin(costs))])
