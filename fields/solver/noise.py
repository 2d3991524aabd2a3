"""Errors of solved heights beyond independent noise: correlated noise, from null (contrast) solutions, and shifts.

The normal matrix takes the noise of each pixel as independent. In blurred, compressed or demosaiced photographs it is
correlated between neighbouring pixels, and interpolated photographs have less of it than their pixels. Contrasts
between the photographs of a survey, to which neither albedo nor height contributes, hold the noise alone: solved like
residuals, they give heights that would be zero without it (null solutions). The residuals that remain along a solved
height hold noise, as the remainder of a contrast does, and the relief of the bed that heights do not follow.

Waves and errors of the poses shift photographs against each other. A height fitted to all photographs absorbs a part of
such a shift and is moved by it. What remains, a shift of the residuals of a photograph along the gradient of the
albedo, common to many pixels, gives the variance of the shifts.
"""

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from fields.solver import uncertainty
from fields.solver.gauss_newton import CG_RESIDUAL, TileSolution, gradients_of, shift_information
from fields.solver.tile import SolverTile
from fields.solver.uncertainty import ONE_STD, QUANTILE_95, SIGMAS_95

# Shifts are constant within a Gauss window of this standard deviation: shorter than waves, wide against noise.
WINDOW_PX = 4.0
# Larger ones are not shifts; and least determinant over squared trace of the structure tensor.
_LARGEST_PX, _LEAST_ACROSS = 2.0, 1e-3
# Share of the Gauss window that a photograph has to see; and photographs that determine more than a height.
_SEEN, _LEAST_VIEWS = 0.5, 3
_LEAST_SHIFTED_PIXELS = 200  # Fewest pixels of a tile
_LARGEST = 6.0  # Contrasts larger than this many times their standard deviation come from something else than noise
_LEAST_PIXELS = 2000  # Fewest pixels
_LEAST_SHARE = 0.05  # Least share of the information in the contrast of a pixel that counts
_RESPONSES = (0.3, 1.5)  # A response beyond these is that of something else than texture
_LEAST_NOISE = 0.05  # Lower bound of the noise shares


@dataclass(frozen=True)
class Shifts:
    """Standard deviation of the shifts of photographs along each axis of the image."""

    pose_std_px: float  # By poses
    wave_std_px_per_m: float  # By waves, for each metre of depth

    def variance(self, depth: np.ndarray) -> np.ndarray:
        """Variance (N,) [px^2] of the shifts at depths (N,) [m], 0 on dry ground."""
        return self.pose_std_px**2 + (self.wave_std_px_per_m * depth) ** 2


def depth_of(height: np.ndarray, is_wet: bool) -> np.ndarray:
    """Depth (N,) [m] of heights (N,) over the water plane; 0 in a survey that has no water."""
    return np.maximum(-height, 0.0) if is_wet else np.zeros_like(height)


def shifts_of(samples: list[tuple[SolverTile, TileSolution]], noise_share: float, is_wet: bool) -> Shifts:
    """Shifts of a survey, from solved tiles; zero where too few pixels are seen by three photographs.

    ``noise_share`` is the ratio of the variance of heights in `NoiseShares`: noise seems to be a shift too, and is
    taken off.
    """
    found = [_in_tile(tile, solved, noise_share) for tile, solved in samples]
    known = [
        (np.mean(square), np.mean(depth_of(solved.height[use], is_wet) ** 2))
        for (square, use), (_, solved) in zip(found, samples, strict=True)
        if use.sum() >= _LEAST_SHIFTED_PIXELS
    ]
    if not known:
        return Shifts(0.0, 0.0)
    # Loading it takes a fifth of a second, which runs without a solver need not spend.
    from scipy.optimize import nnls

    squares, depths = np.array(known).T
    (of_poses, of_waves), _ = nnls(np.stack([np.ones_like(depths), depths], axis=-1), squares)
    return Shifts(float(np.sqrt(of_poses)), float(np.sqrt(of_waves)))


def _in_tile(tile: SolverTile, solved: TileSolution, noise_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Variance [px^2] of the shifts along an axis, and the pixels (N,) bool that determine it."""
    brightness = solved.brightness
    across, down = gradients_of(tile, brightness.albedo)
    area = 4.0 * np.pi * WINDOW_PX**2
    square, of_noise, count = np.zeros((3, len(tile)))
    for weight, residual in zip(brightness.weight, brightness.residual, strict=True):
        xx, xy, yy, x, y, seen = (
            _local_mean(tile, part)
            for part in (
                weight * across * across, weight * across * down, weight * down * down,
                weight * across * residual, weight * down * residual, (weight > 0.0).astype(np.float32),
            )
        )  # fmt: skip
        size, both = xx * yy - xy * xy, xx + yy
        use = (size > _LEAST_ACROSS * both * both) & (seen > _SEEN)
        size = np.where(use, size, 1.0)
        shift = np.hypot(yy * x - xy * y, xx * y - xy * x) / size
        use &= shift < _LARGEST_PX
        square += np.where(use, shift * shift, 0.0)
        of_noise += np.where(use, noise_share * both / size / area, 0.0)
        count += use
    use = count >= _LEAST_VIEWS
    # Of two degrees of freedom per photograph the albedo absorbs two and the height one.
    return (square / np.maximum(2.0 * count - 3.0, 1.0) - of_noise / (2.0 * np.maximum(count, 1.0)))[use], use


def _local_mean(tile: SolverTile, values: np.ndarray) -> np.ndarray:
    """Local mean of values (N,) by a Gauss filter; 0 where there are none."""
    return ndimage.gaussian_filter(tile.image(values), WINDOW_PX, truncate=2.5)[tile.inside]


@dataclass(frozen=True)
class NoiseShares:
    """Variances by noise, relative to those that independent noise of the pixels would give."""

    response: float  # Median of the response of `TileSolution`
    height_variance_ratio: float  # Variance of the heights
    smoothing_variance_ratio: float  # Variance of their change by smoothing them once more
    # Excess of the relief that the residuals show and the heights do not follow, over the relief that the prior should
    # smooth away, 0 to 1
    excess_relief: float


def median_response(samples: list[tuple[SolverTile, TileSolution]]) -> float:
    """Median gradient response of solved tiles; one where none is known."""
    found = np.array([solved.response for _, solved in samples])
    known = found[np.isfinite(found)]
    return float(np.clip(np.median(known), *_RESPONSES)) if len(known) else 1.0


@dataclass(frozen=True)
class NullSolutions:
    """Null solutions of all samples, heights that contrasts give, and their expected variances; N pixels."""

    null_squared: np.ndarray  # (N,) [m^2]: squared null solution
    null_variance: np.ndarray  # (N,) [m^2]: its expectation for independent noise
    change_squared: np.ndarray  # (N,) [m^2]: squared change of the null solution by smoothing it once more
    change_variance: np.ndarray  # (N,) [m^2]: its expectation for independent noise
    # remainder_squared, residual_squared (N,): squared residuals of the contrast after its null solution, and of the
    # photographs along the solved height; one for a pixel that has independent noise and is not solved
    remainder_squared: np.ndarray
    residual_squared: np.ndarray
    relief_squared: np.ndarray  # (N,): part of the latter by the relief that the prior should smooth away
    shift_variance: np.ndarray  # (N,) [m^2/px^2]: of a height, over that of shifts of the photographs
    height: np.ndarray  # (N,) [m]: of the bed


def null_solutions_of(
    samples: list[tuple[SolverTile, TileSolution]], roughness: float, response: float
) -> NullSolutions:
    """Null solutions of samples with the stiffness of a roughness [m]."""
    parts: list[list[np.ndarray]] = []
    for tile, each in samples:
        solved = each.with_roughness(roughness)
        of_height, information = np.sqrt(solved.information), np.maximum(solved.information, 1e-12)
        gradient, step = uncertainty.residual_step(solved, response)
        residual = (gradient + response * information * step) / np.sqrt(information)
        contrast, null_solution, known = null_solution_of(solved, response)
        change = uncertainty.smoothing_change(solved, null_solution, response)
        expected = uncertainty.expected_variances(tile, solved, response)
        use = known & tile.requested
        of_shift = 1.0 / shift_information(solved.brightness.weight, solved.motion)
        values = (
            null_solution**2, expected.noise, change**2, expected.changed_noise,
            (contrast - response * of_height * null_solution) ** 2, residual**2,
            (response * of_height) ** 2 * expected.relief, of_shift, solved.height,
        )  # fmt: skip
        parts.append([value[use] for value in values])
    return NullSolutions(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def null_solution_of(solved: TileSolution, response: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contrast of unit variance, its null solution [m], and where both are known, (N,) each."""
    contrast, known = _contrast(solved, np.random.default_rng(0))
    right = np.sqrt(solved.information) * contrast
    return contrast, uncertainty.solve_normal_equations(solved, right, response, CG_RESIDUAL), known


def noise_shares(null: NullSolutions, response: float, shifts: Shifts, is_wet: bool) -> NoiseShares:
    """Noise shares from the quantile `QUANTILE_95` of the null solutions; one where too few pixels are known.

    Shifts of photographs move the null solutions like the heights; that is no noise. Nor is the noise of heights larger
    than that of the residuals along them, where contrasts of the photographs hold more than noise.
    """
    if len(null.null_squared) < _LEAST_PIXELS:
        return NoiseShares(response, 1.0, 1.0, 1.0)
    by_shift = shifts.variance(depth_of(null.height, is_wet)) * null.shift_variance
    of_heights = np.quantile((null.null_squared / SIGMAS_95**2 - by_shift) / null.null_variance, QUANTILE_95)
    of_smoothing = np.quantile(null.change_squared / null.change_variance, ONE_STD)
    remainder, residual = np.quantile([null.remainder_squared, null.residual_squared], ONE_STD, axis=1).tolist()
    # What the prior should take is counted as that; more than it goes on below the pixel.
    excess_relief = float(np.quantile((null.residual_squared - remainder) / null.relief_squared, ONE_STD)) - 1.0
    of_heights *= min(residual / remainder, 1.0)
    of_heights, of_smoothing = (max(float(ratio), _LEAST_NOISE) for ratio in (of_heights, of_smoothing))
    return NoiseShares(response, of_heights, of_smoothing, min(max(excess_relief, 0.0), 1.0))


def _contrast(solved: TileSolution, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Contrast of the residuals of each pixel, of unit variance for independent noise, and where it is known, (N,).

    Photographs are taken with their derivatives by the height, of random signs, less what is alike in all of them (the
    albedo), and less what the height does.
    """
    weight, by_height = solved.brightness.weight, solved.residual_by_height
    signs = random.permutation(np.where(np.arange(len(by_height)) % 2, 1.0, -1.0)).astype(np.float32)
    factor = solved.brightness.minus_albedo(signs[:, None] * by_height)
    along = np.einsum("kn,kn,kn->n", weight, factor, by_height) / np.maximum(solved.information, 1e-12)
    factor = factor - along * by_height
    variance = np.einsum("kn,kn,kn->n", weight, factor, factor)
    known = variance > _LEAST_SHARE * solved.information
    value = np.einsum("kn,kn,kn->n", weight, factor, solved.brightness.residual)
    value = np.where(known, value / np.sqrt(np.where(known, variance, 1.0)), 0.0)
    return np.clip(value, -_LARGEST, _LARGEST), known
