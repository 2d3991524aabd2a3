"""What noise does to heights: contrasts between photographs, solved as if they were what the height changes.

The normal matrix counts the noise of each pixel for itself. In blurred, compressed or demosaiced photographs
neighbouring pixels share it, and photographs that are interpolated have less of it than their pixels. Contrasts between
the photographs of a survey, in which neither albedo nor height takes part, have the noise alone: solved like residuals,
they give heights that would be zero without it. What a solved height leaves of the residuals along it holds noise, as
what a phantom leaves of its contrast, and the relief of the bed that heights do not follow.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from fields.solver.shifts import Shifts, depth_of
from fields.solver.smoothness import stiffness_of
from fields.solver.solve import CG_RESIDUAL, Solved, parallax_of
from fields.solver.tile import Tile
from fields.solver.uncertainty import ONE_STD, change_of, expected_of, smoothed

# Contrasts larger than this many times their standard deviation come from something else than noise.
_LARGEST = 6.0
# Fewer pixels tell nothing.
_LEAST_PIXELS = 2000
# Of the information: a pixel whose contrast has less does not speak.
_LEAST_SHARE = 0.05
# A response beyond these is that of something else than texture.
_RESPONSES = (0.3, 1.5)
# Of normally distributed values, so many lie within so many standard deviations.
_MOST, _WITHIN = 0.95, 1.96
# No noise is so much smaller than it seems.
_LEAST_NOISE = 0.05


@dataclass(frozen=True)
class NoiseShares:
    """What noise is worth, in units of independent noise of the pixels.

    Attributes
    ----------
    response : float
        How much of the information the residuals answer with.
    heights, changes : float
        Of the variance of heights by noise, and of what smoothing them once more changes.
    unfollowed : float
        Not of noise, but of the relief that the prior should take from the bed: how much more than that the residuals
        show that the heights do not follow, 0 to 1.
    """

    response: float
    heights: float
    changes: float
    unfollowed: float


def response_of(samples: list[tuple[Tile, Solved]]) -> float:
    """How much of their information the residuals of solved tiles answer with; one where nothing tells it."""
    found = np.array([solved.response for _, solved in samples])
    known = found[np.isfinite(found)]
    return float(np.clip(np.median(known), *_RESPONSES)) if len(known) else 1.0


@dataclass(frozen=True)
class Phantoms:
    """Heights that contrasts give, of all samples together, and what is expected of them; N pixels.

    Attributes
    ----------
    square, expected : (N,) [m^2]
        Of the heights; expected for independent noise.
    changed, expected_change : (N,) [m^2]
        Of what smoothing them once more changes.
    left, residual : (N,)
        Squares of what a phantom leaves of its contrast, and a height of the residuals along it; one for a pixel that
        has independent noise and is not solved.
    relief : (N,)
        What the relief that the prior should take from the bed adds to the latter.
    shift : (N,)
        Of a height, by a shift of each photograph by one pixel.
    height : (N,) [m]
        Of the bed.
    """

    square: np.ndarray
    expected: np.ndarray
    changed: np.ndarray
    expected_change: np.ndarray
    left: np.ndarray
    residual: np.ndarray
    relief: np.ndarray
    shift: np.ndarray
    height: np.ndarray


def phantoms_of(samples: list[tuple[Tile, Solved]], roughness: float, response: float) -> Phantoms:
    """Solve a contrast of each sample with the stiffness that a roughness [m] gives it."""
    parts: list[list[np.ndarray]] = []
    for tile, each in samples:
        solved = replace(each, stiffness=stiffness_of(each.bends.of_heights @ each.height, roughness))
        of_height = np.sqrt(solved.information)
        contrast, phantom, known = phantom_of(solved, response)
        change, expected = change_of(solved, phantom, response), expected_of(tile, solved, response)
        use = known & tile.asked
        of_shift = 1.0 / parallax_of(solved.brightness.weight, solved.motion)
        values = (
            phantom**2, expected.noise, change**2, expected.changed_noise,
            (contrast - response * of_height * phantom) ** 2, _along_height(solved, response) ** 2,
            (response * of_height) ** 2 * expected.relief, of_shift, solved.height,
        )  # fmt: skip
        parts.append([value[use] for value in values])
    return Phantoms(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def phantom_of(solved: Solved, response: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A contrast of unit variance, the height [m] that it gives, and where both are known, (N,) each."""
    contrast, known = _contrast(solved, np.random.default_rng(0))
    return contrast, smoothed(solved, np.sqrt(solved.information) * contrast, response, CG_RESIDUAL), known


def noise_shares(phantoms: Phantoms, response: float, shifts: Shifts, is_wet: bool) -> NoiseShares:
    """What noise is worth, as `_MOST` of the phantoms say; one where fewer than three photographs see too many of them.

    Photographs that are shifted move the phantoms like the heights; that is no noise. Nor have heights more noise than
    the residuals along them show, where contrasts of the photographs hold more than noise.
    """
    if len(phantoms.square) < _LEAST_PIXELS:
        return NoiseShares(response, 1.0, 1.0, 1.0)
    by_shift = shifts.variance(depth_of(phantoms.height, is_wet)) * phantoms.shift
    heights = np.quantile((phantoms.square / _WITHIN**2 - by_shift) / phantoms.expected, _MOST)
    changes = np.quantile(phantoms.changed / phantoms.expected_change, ONE_STD)
    left, residual = (float(np.quantile(each, ONE_STD)) for each in (phantoms.left, phantoms.residual))
    # What the prior should take is counted as that; more than it goes on below the pixel.
    unfollowed = float(np.quantile((phantoms.residual - left) / phantoms.relief, ONE_STD)) - 1.0
    heights *= min(residual / left, 1.0)
    return NoiseShares(
        response, max(float(heights), _LEAST_NOISE), max(float(changes), _LEAST_NOISE), min(max(unfollowed, 0.0), 1.0)
    )


def _along_height(solved: Solved, response: float) -> np.ndarray:
    """What the heights that the stiffness gives leave of the residuals along them, (N,): 1 for independent noise alone
    where nothing is solved."""
    pull = np.einsum("kn,kn,kn->n", solved.brightness.weight, solved.slope, solved.brightness.residual)
    right = -pull - solved.bends.pull(solved.stiffness, solved.height)
    step = smoothed(solved, right, response, CG_RESIDUAL)
    information = np.maximum(solved.information, 1e-12)
    return (pull + response * information * step) / np.sqrt(information)


def _contrast(solved: Solved, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """A sum of the residuals of each pixel with unit variance for independent noise, and where it is known, (N,) each.

    Photographs are taken with slopes of random signs, less what is alike in all of them (the albedo), and less what the
    height does.
    """
    weight, slope = solved.brightness.weight, solved.slope
    signs = random.permutation(np.where(np.arange(len(slope)) % 2, 1.0, -1.0)).astype(np.float32)
    factor = solved.brightness.less_mean(signs[:, None] * slope)
    along = np.einsum("kn,kn,kn->n", weight, factor, slope) / np.maximum(solved.information, 1e-12)
    factor = factor - along * slope
    variance = np.einsum("kn,kn,kn->n", weight, factor, factor)
    known = variance > _LEAST_SHARE * solved.information
    value = np.einsum("kn,kn,kn->n", weight, factor, solved.brightness.residual)
    value = np.where(known, value / np.sqrt(np.where(known, variance, 1.0)), 0.0)
    return np.clip(value, -_LARGEST, _LARGEST), known
