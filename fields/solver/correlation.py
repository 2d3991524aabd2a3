"""Noise of solved heights, from null (contrast) solutions: contrasts between photographs that hold noise alone.

The normal matrix takes the noise of each pixel as independent. In blurred, compressed or demosaiced photographs it is
correlated between neighbouring pixels, and interpolated photographs have less of it than their pixels. Contrasts
between the photographs of a survey, to which neither albedo nor height contributes, hold the noise alone: solved like
residuals, they give heights that would be zero without it (null solutions). The residuals that remain along a solved
height hold noise, as the remainder of a contrast does, and the relief of the bed that heights do not follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fields.solver.gauss_newton import CG_RESIDUAL, TileSolution, shift_information, stiffness_of
from fields.solver.shifts import Shifts, depth_of
from fields.solver.tile import Tile
from fields.solver.uncertainty import ONE_STD, expected_variances, smoothing_change, solve_normal_equations

# Contrasts larger than this many times their standard deviation come from something else than noise.
_LARGEST = 6.0
# Fewest pixels.
_LEAST_PIXELS = 2000
# Least share of the information in the contrast of a pixel that counts.
_LEAST_SHARE = 0.05
# A response beyond these is that of something else than texture.
_RESPONSES = (0.3, 1.5)
# Of normally distributed values, so many lie within so many standard deviations.
_MOST, _WITHIN = 0.95, 1.96
# Lower bound of the noise shares.
_LEAST_NOISE = 0.05


@dataclass(frozen=True)
class NoiseShares:
    """Variances by noise, relative to independent noise of the pixels."""

    response: float  # Median of the response of `TileSolution`
    # heights, changes: Of the variance of heights by noise, and of their change by smoothing them once more
    heights: float
    changes: float
    # Excess of the relief that the residuals show and the heights do not follow, over the relief that the prior should
    # smooth away, 0 to 1
    excess_relief: float


def median_response(samples: list[tuple[Tile, TileSolution]]) -> float:
    """Median gradient response of solved tiles; one where none is known."""
    found = np.array([solved.response for _, solved in samples])
    known = found[np.isfinite(found)]
    return float(np.clip(np.median(known), *_RESPONSES)) if len(known) else 1.0


@dataclass(frozen=True)
class NullSolutions:
    """Null solutions of all samples, heights that contrasts give, and their expected variances; N pixels."""

    # square, expected (N,) [m^2]: of the heights; expected for independent noise
    square: np.ndarray
    expected: np.ndarray
    # changed, expected_change (N,) [m^2]: of their change by smoothing them once more
    changed: np.ndarray
    expected_change: np.ndarray
    # left, residual (N,): squared residuals of the contrast after its null solution, and of the photographs along the
    # solved height; one for a pixel that has independent noise and is not solved
    left: np.ndarray
    residual: np.ndarray
    relief: np.ndarray  # (N,): share of the latter by the relief that the prior should smooth away
    shift: np.ndarray  # (N,): of a height, by a shift of each photograph by one pixel
    height: np.ndarray  # (N,) [m]: of the bed


def null_solutions_of(samples: list[tuple[Tile, TileSolution]], roughness: float, response: float) -> NullSolutions:
    """Null solutions of samples with the stiffness of a roughness [m]."""
    parts: list[list[np.ndarray]] = []
    for tile, each in samples:
        solved = replace(each, stiffness=stiffness_of(each.differences.matrix @ each.height, roughness))
        of_height = np.sqrt(solved.information)
        contrast, null_solution, known = null_solution_of(solved, response)
        change, expected = smoothing_change(solved, null_solution, response), expected_variances(tile, solved, response)
        use = known & tile.requested
        of_shift = 1.0 / shift_information(solved.brightness.weight, solved.motion)
        values = (
            null_solution**2, expected.noise, change**2, expected.changed_noise,
            (contrast - response * of_height * null_solution) ** 2, _residual_along_height(solved, response) ** 2,
            (response * of_height) ** 2 * expected.relief, of_shift, solved.height,
        )  # fmt: skip
        parts.append([value[use] for value in values])
    return NullSolutions(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def null_solution_of(solved: TileSolution, response: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contrast of unit variance, its null solution [m], and where both are known, (N,) each."""
    contrast, known = _contrast(solved, np.random.default_rng(0))
    return (
        contrast,
        solve_normal_equations(solved, np.sqrt(solved.information) * contrast, response, CG_RESIDUAL),
        known,
    )


def noise_shares(null_solutions: NullSolutions, response: float, shifts: Shifts, is_wet: bool) -> NoiseShares:
    """Noise shares from the quantile `_MOST` of the null solutions; one where too few pixels are known.

    Shifts of photographs move the null solutions like the heights; that is no noise. Nor is the noise of heights larger
    than that of the residuals along them, where contrasts of the photographs hold more than noise.
    """
    if len(null_solutions.square) < _LEAST_PIXELS:
        return NoiseShares(response, 1.0, 1.0, 1.0)
    by_shift = shifts.variance(depth_of(null_solutions.height, is_wet)) * null_solutions.shift
    heights = np.quantile((null_solutions.square / _WITHIN**2 - by_shift) / null_solutions.expected, _MOST)
    changes = np.quantile(null_solutions.changed / null_solutions.expected_change, ONE_STD)
    left, residual = (float(np.quantile(each, ONE_STD)) for each in (null_solutions.left, null_solutions.residual))
    # What the prior should take is counted as that; more than it goes on below the pixel.
    excess_relief = float(np.quantile((null_solutions.residual - left) / null_solutions.relief, ONE_STD)) - 1.0
    heights *= min(residual / left, 1.0)
    return NoiseShares(
        response,
        max(float(heights), _LEAST_NOISE),
        max(float(changes), _LEAST_NOISE),
        min(max(excess_relief, 0.0), 1.0),
    )


def _residual_along_height(solved: TileSolution, response: float) -> np.ndarray:
    """Residuals along the solved heights (N,): 1 for independent noise alone where nothing is solved."""
    gradient = np.einsum("kn,kn,kn->n", solved.brightness.weight, solved.slope, solved.brightness.residual)
    right = -gradient - solved.differences.gradient(solved.stiffness, solved.height)
    step = solve_normal_equations(solved, right, response, CG_RESIDUAL)
    information = np.maximum(solved.information, 1e-12)
    return (gradient + response * information * step) / np.sqrt(information)


def _contrast(solved: TileSolution, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Contrast of the residuals of each pixel, of unit variance for independent noise, and where it is known, (N,).

    Photographs are taken with slopes of random signs, less what is alike in all of them (the albedo), and less what the
    height does.
    """
    weight, slope = solved.brightness.weight, solved.slope
    signs = random.permutation(np.where(np.arange(len(slope)) % 2, 1.0, -1.0)).astype(np.float32)
    factor = solved.brightness.minus_albedo(signs[:, None] * slope)
    along = np.einsum("kn,kn,kn->n", weight, factor, slope) / np.maximum(solved.information, 1e-12)
    factor = factor - along * slope
    variance = np.einsum("kn,kn,kn->n", weight, factor, factor)
    known = variance > _LEAST_SHARE * solved.information
    value = np.einsum("kn,kn,kn->n", weight, factor, solved.brightness.residual)
    value = np.where(known, value / np.sqrt(np.where(known, variance, 1.0)), 0.0)
    return np.clip(value, -_LARGEST, _LARGEST), known
