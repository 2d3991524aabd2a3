"""How sure a height is: what noise does to it, and what the prior takes from the bed there."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from fields.solver.solve import FAINT, Solved, conjugate_gradients, normal_matrix
from fields.solver.tile import Tile
from fields.solver.waves import FALL_OF_PRIOR, means_at

# Information and stiffness are alike over about the range in which heights are correlated [px].
_ALIKE_PX = 1.5
# How much relief the prior takes from the bed is alike in a bell of this standard deviation [px].
_NEAR_PX = 4.0
# Bells end at so many standard deviations.
_TRUNCATED = 3.0
# About edges, what the tile as a whole says of its relief counts as much as so many independent values: where there is
# more than chance explains by one (a little) to two (all) standard deviations.
_WHOLE_AT_EDGES = 2.0
# Share of a normal distribution below one standard deviation less than its mean.
_ONE_STD_BELOW = 0.1587
# Of a normal distribution, the share within one standard deviation; large values of some do not move the rest.
ONE_STD = 0.6827
# Changes are wanted to a few hundredths: conjugate gradients, relative to the start.
_CHANGE_RESIDUAL = 0.01


@dataclass(frozen=True)
class Expected:
    """Variances (N,) [m^2] that noise and relief should have, for independent noise and the relief of the prior.

    Attributes
    ----------
    noise : (N,)
        Of a height, by noise.
    relief : (N,)
        Of a height, by relief that the prior takes from the bed.
    changed_noise, changed_relief : (N,)
        Of what smoothing a height once more changes.
    bends_noise : (N,)
        Of the bends about a height, by noise.
    independent : (N,)
        How many independent values of that the bell about a pixel has.
    """

    noise: np.ndarray
    relief: np.ndarray
    changed_noise: np.ndarray
    changed_relief: np.ndarray
    bends_noise: np.ndarray
    independent: np.ndarray


def expected_of(tile: Tile, solved: Solved, response: float, fall: float = FALL_OF_PRIOR) -> Expected:
    """What is expected of the heights of a tile, as if the normal matrix were the same all around each pixel.

    Then each wave of the heights is solved on its own, and the variance of a height is the mean over all waves
    (`fields.solver.waves`). Smoothed once more, a wave changes by what the prior takes of it. ``fall`` is how steeply
    the bed's power falls with the frequency (`fields.solver.fall.fall_of`).
    """
    answer, log_ratio = answer_of(tile, solved, response)
    means, of_noise = means_at(log_ratio, fall), 1.0 / (response * answer)
    return Expected(
        means.noise * of_noise, means.relief / answer, means.changed_noise * of_noise, means.changed_relief / answer,
        means.bends_noise * of_noise, 4.0 * np.pi * _NEAR_PX**2 / means.alike,
    )  # fmt: skip


def answer_of(tile: Tile, solved: Solved, response: float) -> tuple[np.ndarray, np.ndarray]:
    """How much the residuals answer to a height about each pixel (N,) [1/m^2], and the logarithm (N,) of the ratio of
    the stiffness to it."""
    # Compliances add up, as those of springs in a row: one loose bend frees a height.
    compliance = _near(tile, solved.bends.mean_about(1.0 / solved.stiffness), _ALIKE_PX)
    answer = response * _near(tile, solved.information, _ALIKE_PX) + FAINT
    return answer, np.log(1.0 / (np.maximum(compliance, 1e-12) * answer))


def smoothed(solved: Solved, right: np.ndarray, response: float, residual: float) -> np.ndarray:
    """Heights (N,) of a right side (N,) of the normal equations, whose information is what the residuals answer to."""
    answer = np.float32(response) * solved.information
    matrix = normal_matrix(answer, solved.bends, solved.stiffness)
    diagonal = answer + solved.bends.squared @ solved.stiffness + FAINT
    return conjugate_gradients(matrix, right.astype(np.float32), diagonal, residual)


def change_of(solved: Solved, heights: np.ndarray, response: float) -> np.ndarray:
    """How much heights (N,) [m] change where they are smoothed once more, (N,) [m]."""
    return smoothed(solved, solved.bends.pull(solved.stiffness, heights), response, _CHANGE_RESIDUAL)


def relief_of(tile: Tile, change: np.ndarray, expected: Expected, noise: float, changed_noise: float) -> np.ndarray:
    """Variance (N,) [m^2] of heights by relief that the prior takes from the bed.

    What smoothing once more changes is relief where it is more than noise (``noise`` and ``changed_noise`` are the
    shares of `fields.solver.correlation.NoiseShares`). About a pixel that is known from a few independent values only:
    they count together with what the whole tile says.
    """
    square, by_noise = change * change, changed_noise * expected.changed_noise
    by_relief = noise * expected.changed_relief
    # The relief with which that share of the tile lies within one standard deviation.
    whole = max(float(np.quantile(((square - by_noise) / by_relief)[tile.asked], ONE_STD)), 0.0)
    number, everywhere = expected.independent, by_noise + whole * by_relief
    near = _near(tile, square, _NEAR_PX)
    count = worth_of_whole(near / everywhere, tile.asked, float(np.median(number[tile.asked])))
    here = (number * near + count * everywhere) / (number + count)
    return np.maximum(here - by_noise, 0.0) * expected.relief / expected.changed_relief


def worth_of_whole(ratio: np.ndarray, asked: np.ndarray, number: float) -> np.ndarray:
    """As how many independent values (N,) the mean over a tile counts for each place of it.

    ``ratio`` (N,) is that of the mean square about each pixel, of ``number`` independent values, to what the tile as a
    whole lets expect. Over the ``asked`` it spreads by chance, and by as much more as places differ: the variance of
    the latter, v, is that of 2 / v values (empirical Bayes, the conjugate prior of a variance), and no more than the
    tile has. It is taken from below the median, where no edges are.
    """
    # Cube roots of such mean squares are normal (Wilson and Hilferty 1931).
    root = np.cbrt(np.maximum(ratio, 1e-9))
    low, middle = np.quantile(root[asked], (_ONE_STD_BELOW, 0.5))
    by_chance = np.sqrt(2.0 / (9.0 * number))
    spread = (middle - low) / middle
    bells = max(np.count_nonzero(asked) / (4.0 * np.pi * _NEAR_PX**2), 1.0)
    # A root varies by a third of what its cube does.
    count = 2.0 / max(9.0 * (spread**2 - by_chance**2), 2.0 / (number * bells))
    beyond = np.clip((root / middle - 1.0) / max(spread, by_chance) - 1.0, 0.0, 1.0)
    return count * (min(_WHOLE_AT_EDGES / count, 1.0)) ** beyond


def bends_below(solved: Solved, expected: Expected, noise: float, unfollowed: float) -> np.ndarray:
    """Variance (N,) [m^2] of the bed within a pixel by how it bends there.

    Noise bends the solved heights, too. Its part is taken off as far as the photographs show no more relief of the
    pixels than what the prior should take from the bed (``noise`` and ``unfollowed`` of
    `fields.solver.correlation.NoiseShares`): a bed that has none has none below the pixel.
    """
    bend = solved.bends.of_heights @ solved.height
    by_noise = (1.0 - unfollowed) * noise * expected.bends_noise
    return np.maximum(solved.bends.mean_about(bend * bend) - by_noise, 0.0)


def rise_of(tile: Tile, height: np.ndarray) -> np.ndarray:
    """Rise (N,) [m/px] of heights (N,) [m] over the pixels next to each."""
    beside = np.ones((3, 3), dtype=np.uint8)
    highest, lowest = (np.full(tile.inside.shape, bound, dtype=np.float32) for bound in (-np.inf, np.inf))
    highest[tile.inside] = lowest[tile.inside] = height
    return 0.5 * (cv2.dilate(highest, beside)[tile.inside] - cv2.erode(lowest, beside)[tile.inside])


def _near(tile: Tile, values: np.ndarray, alike_px: float) -> np.ndarray:
    """Mean of values (N,) around each pixel of the tile."""
    total, weight = (_spread(tile, part, alike_px) for part in (values, np.ones(len(tile))))
    return total / np.maximum(weight, 1e-9)


def _spread(tile: Tile, values: np.ndarray, alike_px: float) -> np.ndarray:
    image = np.zeros(tile.inside.shape, dtype=np.float32)
    image[tile.inside] = values
    side = 2 * round(_TRUNCATED * alike_px) + 1
    return cv2.GaussianBlur(image, (side, side), alike_px, borderType=cv2.BORDER_REFLECT)[tile.inside]
