"""Standard deviation of solved heights: by noise, and by the relief that the prior smooths away.

Means over the spectrum of a bed of equal pixels: with information H of a height, of which the residuals respond with
``A = response * H``, and stiffness q, a wave of the bed is multiplied by ``A / (A + q S)``, with S the square of the
symbol of the Laplacian: the power that the prior expects of the bed is ``1 / (q S)``. Beds of another roughness at
small than at large scale have ``1 / S**slope``. All depends on the ratio of q to A alone.
"""

from dataclasses import dataclass
from functools import cache

import cv2
import numpy as np

from fields.solver.gauss_newton import CG_RESIDUAL, LEAST_INFORMATION, TileSolution
from fields.solver.tile import SolverTile

# Information and stiffness are taken as constant over about the range in which heights are correlated [px].
_ALIKE_PX = 1.5
# The relief that the prior smooths away is taken as constant in a Gauss window of this standard deviation [px].
_NEAR_PX = 4.0
_TRUNCATED = 3.0  # Gauss windows end at so many standard deviations
# About edges, what the tile as a whole says of its relief counts as much as so many independent values: where there is
# more than chance explains by one (a little) to two (all) standard deviations.
_WHOLE_AT_EDGES = 2.0
# The ten second differences of a height are worth five independent ones or so: of their mean square, the square of the
# mean root is this part (chi distribution; 0.88 to 0.93 at heights correlated over 0 to 3 px), and in one of a hundred
# it is too small by more than this factor.
_SQUARE_OF_MEAN_ROOT, _MOST_BY_CHANCE = 0.9, 9.0
_ONE_STD_BELOW = 0.1587  # Share of a normal distribution below one standard deviation less than its mean
# Of a normal distribution, the share within one standard deviation; large values of some do not move the rest.
ONE_STD = 0.6827
QUANTILE_95, SIGMAS_95 = 0.95, 1.96  # Of a normal distribution, this share lies within so many standard deviations
_CHANGE_RESIDUAL = 0.01  # Changes are wanted to a few hundredths: conjugate gradients, relative to the start
# Spectral slope of the bed, as an exponent of the power that the prior expects.
PRIOR_SPECTRAL_SLOPE = 1.0
_FREQUENCIES, _RATIOS = 256, np.logspace(-4.0, 9.0, 66)


@dataclass(frozen=True)
class ExpectedVariances:
    """Expected variances (N,) [m^2] for independent noise and the relief of the prior."""

    noise: np.ndarray  # (N,): of a height, by noise
    relief: np.ndarray  # (N,): of a height, by relief that the prior takes from the bed
    # changed_noise, changed_relief (N,): of the change by smoothing a height once more
    changed_noise: np.ndarray
    changed_relief: np.ndarray
    differences_noise: np.ndarray  # (N,): of the second differences of a height, by noise
    independent: np.ndarray  # (N,): how many independent values of that the Gauss window about a pixel has


def expected_variances(
    tile: SolverTile, solved: TileSolution, response: float, spectral_slope: float = PRIOR_SPECTRAL_SLOPE
) -> ExpectedVariances:
    """Expected variances of the heights of a tile, for a normal matrix that is uniform around each pixel.

    Each wave of the heights is then solved on its own, and the variance of a height is the mean over all waves.
    Smoothed once more, a wave changes by the share that the prior removes. ``spectral_slope`` is that of the bed
    (`fields.solver.roughness.spectral_slope_of`).
    """
    effective, log_ratio = effective_information(tile, solved, response)
    means, of_noise = spectral_means(log_ratio, spectral_slope), 1.0 / (response * effective)
    return ExpectedVariances(
        noise=means.noise * of_noise,
        relief=means.relief / effective,
        changed_noise=means.changed_noise * of_noise,
        changed_relief=means.changed_relief / effective,
        differences_noise=means.differences_noise * of_noise,
        independent=4.0 * np.pi * _NEAR_PX**2 / means.correlated_px,
    )


def effective_information(tile: SolverTile, solved: TileSolution, response: float) -> tuple[np.ndarray, np.ndarray]:
    """Effective information of a height around each pixel (N,) [1/m^2], and the logarithm (N,) of the ratio of the
    stiffness to it."""
    # Compliances add up, as those of springs in series: one loose second difference frees a height.
    compliance = _local_mean(tile, solved.differences.mean_at_heights(1.0 / solved.stiffness), _ALIKE_PX)
    effective = response * _local_mean(tile, solved.information, _ALIKE_PX) + LEAST_INFORMATION
    return effective, np.log(1.0 / (np.maximum(compliance, 1e-12) * effective))


def solve_normal_equations(solved: TileSolution, right: np.ndarray, response: float, residual: float) -> np.ndarray:
    """Heights (N,) for a right side (N,) of the normal equations with the effective information."""
    effective = np.float32(response) * solved.information
    return solved.differences.solve(effective, solved.stiffness, right.astype(np.float32), residual)


def residual_step(solved: TileSolution, response: float) -> tuple[np.ndarray, np.ndarray]:
    """Gradient (N,) [1/m] of the residuals at the solved heights, and another step (N,) [m] with the same stiffness."""
    gradient = np.einsum("kn,kn,kn->n", solved.brightness.weight, solved.residual_by_height, solved.brightness.residual)
    right = -gradient - solved.differences.gradient(solved.stiffness, solved.height)
    return gradient, solve_normal_equations(solved, right, response, CG_RESIDUAL)


def smoothing_change(solved: TileSolution, heights: np.ndarray, response: float) -> np.ndarray:
    """Change (N,) [m] of heights (N,) [m] by smoothing them once more."""
    return solve_normal_equations(
        solved, solved.differences.gradient(solved.stiffness, heights), response, _CHANGE_RESIDUAL
    )


def smoothed_relief(
    tile: SolverTile, change: np.ndarray, expected: ExpectedVariances, noise: float, changed_noise: float
) -> np.ndarray:
    """Variance (N,) [m^2] of heights by the relief that the prior smooths away.

    The change by smoothing once more is relief where it is more than noise (``noise`` and ``changed_noise`` are the
    shares of `fields.solver.noise.NoiseShares`). About a pixel that is known from a few independent values only:
    they count together with what the whole tile says.
    """
    square, by_noise = change * change, changed_noise * expected.changed_noise
    by_relief = noise * expected.changed_relief
    # The relief with which that share of the tile lies within one standard deviation.
    relief_scale = max(float(np.quantile(((square - by_noise) / by_relief)[tile.requested], ONE_STD)), 0.0)
    number, everywhere = expected.independent, by_noise + relief_scale * by_relief
    near = _local_mean(tile, square, _NEAR_PX)
    count = effective_sample_weight(near / everywhere, tile.requested, float(np.median(number[tile.requested])))
    expected_square = (number * near + count * everywhere) / (number + count)
    return np.maximum(expected_square - by_noise, 0.0) * expected.relief / expected.changed_relief


def effective_sample_weight(ratio: np.ndarray, requested: np.ndarray, number: float) -> np.ndarray:
    """Effective number of independent values (N,) of the mean over a tile, as a prior at each pixel.

    ``ratio`` (N,) is that of the mean square about each pixel, of ``number`` independent values, to the mean over the
    tile. Over the ``requested`` pixels it spreads by chance, and beyond that as places differ: the variance v of the
    latter is that of 2 / v values (empirical Bayes, the conjugate prior of a variance), and no more than the tile has.
    It is taken from below the median, where no edges are.
    """
    # Cube roots of such mean squares are normal (Wilson and Hilferty 1931).
    root = np.cbrt(np.maximum(ratio, 1e-9))
    low, middle = np.quantile(root[requested], (_ONE_STD_BELOW, 0.5))
    by_chance = np.sqrt(2.0 / (9.0 * number))
    spread = (middle - low) / middle
    areas = max(np.count_nonzero(requested) / (4.0 * np.pi * _NEAR_PX**2), 1.0)
    # A root varies by a third of what its cube does.
    count = 2.0 / max(9.0 * (spread**2 - by_chance**2), 2.0 / (number * areas))
    beyond = np.clip((root / middle - 1.0) / max(spread, by_chance) - 1.0, 0.0, 1.0)
    return count * (min(_WHOLE_AT_EDGES / count, 1.0)) ** beyond


def subpixel_relief(
    tile: SolverTile, solved: TileSolution, expected: ExpectedVariances, noise: float, excess_relief: float
) -> np.ndarray:
    """Variance (N,) [m^2] of the bed within a pixel, from its second differences.

    Those of a single height are a few values, small by chance as often as the bed is smooth: a mean about it counts, as
    far as chance explains that it is larger: an edge is no relief of the ground beside it.
    The share of noise in the second differences is subtracted as far as the photographs show no more relief of the
    pixels than what the prior should take from the bed (``noise`` and ``excess_relief`` of
    `fields.solver.noise.NoiseShares`): a bed that has none has none below the pixel.
    """
    differences = solved.differences.matrix @ solved.height
    by_noise = (1.0 - excess_relief) * noise * expected.differences_noise
    own = solved.differences.mean_at_heights(differences * differences)
    near = _local_mean(tile, np.sqrt(own), _ALIKE_PX) ** 2 / _SQUARE_OF_MEAN_ROOT
    return np.maximum(np.minimum(near, _MOST_BY_CHANCE * own) - by_noise, 0.0)


def local_slope(tile: SolverTile, height: np.ndarray) -> np.ndarray:
    """Slope (N,) [m/px] of heights (N,) [m] over the adjacent pixels."""
    window = np.ones((3, 3), dtype=np.uint8)
    highest, lowest = (np.full(tile.inside.shape, bound, dtype=np.float32) for bound in (-np.inf, np.inf))
    highest[tile.inside] = lowest[tile.inside] = height
    return 0.5 * (cv2.dilate(highest, window)[tile.inside] - cv2.erode(lowest, window)[tile.inside])


def _local_mean(tile: SolverTile, values: np.ndarray, alike_px: float) -> np.ndarray:
    """Mean of values (N,) around each pixel of the tile."""
    side = 2 * round(_TRUNCATED * alike_px) + 1
    total, weight = (
        cv2.GaussianBlur(tile.image(part), (side, side), alike_px, borderType=cv2.BORDER_REFLECT)[tile.inside]
        for part in (values, np.ones(len(tile)))
    )
    return total / np.maximum(weight, 1e-9)


@dataclass(frozen=True)
class SpectralMeans:
    """Means over the spectrum at ratios (N,) of stiffness to effective information."""

    # noise, relief (N,): of the noise of a height, and of the relief that the prior takes from it
    noise: np.ndarray
    relief: np.ndarray
    # changed_noise, changed_relief (N,): of both in the change by smoothing a height once more
    changed_noise: np.ndarray
    changed_relief: np.ndarray
    twice_changed_relief: np.ndarray  # (N,): of relief in the change of that change by smoothing it in turn
    differences_noise: np.ndarray  # (N,): of noise in the second differences of a height
    correlated_px: np.ndarray  # (N,) [px^2]: number of pixels over which the change is correlated


def spectral_means(log_ratio: np.ndarray | float, spectral_slope: float) -> SpectralMeans:
    """Spectral means for logarithms (N,) of the ratio of stiffness to effective information, and a spectral slope."""
    return SpectralMeans(*(np.exp(np.interp(log_ratio, np.log(_RATIOS), row)) for row in _shares(spectral_slope)))


@cache
def _symbols() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Symbols of the squared Laplacian and of the second differences of a height, and shares of the spectrum.

    At frequencies (F,) of a quarter of the spectrum, which the others mirror.
    """
    along = 2.0 - 2.0 * np.cos(2.0 * np.pi * np.arange(_FREQUENCIES // 2 + 1) / _FREQUENCIES)
    share = np.full(len(along), 2.0 / _FREQUENCIES)
    share[[0, -1]] *= 0.5
    # Of the ten second differences of a height three are along rows, three along columns and four across both.
    second = 0.3 * (along[:, None] ** 2 + along**2) + 0.8 * along[:, None] * along
    return ((along[:, None] + along) ** 2).ravel(), second.ravel(), np.outer(share, share).ravel()


@cache
def _by_ratio() -> tuple[np.ndarray, np.ndarray]:
    """`SpectralMeans` of noise and its pixels (4, ratios), and weights (3, ratios, F) of the bed's power in others."""
    symbol, second, share = _symbols()
    transfer = 1.0 / (1.0 + _RATIOS[:, None] * symbol)
    noise, taken = transfer**2, (1.0 - transfer) ** 2
    changed = taken * noise
    mean = changed @ share
    # What the prior expects of the bed at that ratio, at the spectral slope of the prior.
    relief = taken * share / _RATIOS[:, None]
    of_noise = noise @ share, mean, noise @ (second * share), (changed**2 @ share) / mean**2
    return np.stack(of_noise), np.stack([relief, relief * noise, relief * changed])


@cache
def _shares(spectral_slope: float) -> np.ndarray:
    """Logarithms of `SpectralMeans` (7, ratios)."""
    symbol, (of_noise, of_power) = _symbols()[0], _by_ratio()
    # A constant is not relief.
    power = np.where(symbol > 0.0, np.maximum(symbol, 1e-30) ** -spectral_slope, 0.0)
    noise, changed, differences, correlated_px = of_noise
    relief, changed_relief, twice = of_power @ power
    return np.log([noise, relief, changed, changed_relief, twice, differences, correlated_px])
