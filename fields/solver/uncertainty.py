"""How sure a height is: the normal matrix, what moves between photographs, and the relief below the pixel."""

from __future__ import annotations

from concurrent.futures import Executor
from functools import cache

import numpy as np
from scipy import ndimage

from fields.solver.roughness import halves_of, heights_of
from fields.solver.smoothness import stiffness_of
from fields.solver.solve import FAINT, Solved, conjugate_gradients, normal_matrix
from fields.solver.tile import Tile

# Information and stiffness are alike over about the range in which heights are correlated [px].
_ALIKE_PX = 1.5
# A point lies anywhere in its pixel: its place along each axis has this standard deviation [px].
_PLACE_PX = 1.0 / np.sqrt(12.0)
# A half of the photographs that has less than this share of the information of all does not speak for itself.
_OWN_SHARE, _LEAST_PIXELS = 0.2, 1000
# Shifts are read where so large a share of the differences is smaller: they vary from place to place, and the larger
# ones decide what a standard deviation has to cover. Of a normal variable as many are within 1.645.
_SHARE, _WITHIN = 0.9, 1.645
# Information is at least this share of what it seems to be.
_LEAST_TRUE = 0.1
_FREQUENCIES, _RATIOS = 256, np.logspace(-4.0, 9.0, 66)


def variance_of(tile: Tile, solved: Solved) -> np.ndarray:
    """Variance (N,) [m^2] by noise and prior: the diagonal of the inverse of the normal matrix, as if it were the same
    all around each pixel.

    There it has a closed form: with information H and stiffness q, each wave of the heights has the variance
    ``1 / (H + q S)``, with S the square of the symbol of Laplace's operator, and the variance of a height is the mean
    over all waves. The inverse itself would need a solve for each pixel; on drawn surveys its diagonal differs by 2 %
    in the median, by a quarter from pixel to pixel.

    Noise of the gradients moves the heights as texture does but tells nothing of them: of the sum of squares H' only
    H is information, and a wave has ``(H' + q S) / (H + q S)^2``.
    """
    bends = solved.bends.squared.copy()
    bends.data = np.ones_like(bends.data)
    touching = np.maximum(np.diff(bends.indptr), 1)
    # Compliances add up, as those of springs in a row: one loose bend frees a height.
    compliance = _nearby(tile, (bends @ (1.0 / solved.stiffness)) / touching)
    seeming = _nearby(tile, solved.information) + FAINT
    information = np.maximum(seeming - _nearby(tile, solved.of_noise), _LEAST_TRUE * seeming)
    ratio = np.log(1.0 / (np.maximum(compliance, 1e-12) * information))
    once, twice = (np.exp(np.interp(ratio, np.log(_RATIOS), shares)) for shares in _shares())
    return (once + (seeming / information - 1.0) * twice) / information


def below_pixel(tile: Tile, solved: Solved) -> np.ndarray:
    """Variance (N,) [m^2] of the bed within a pixel: how it bends there, and its slope over the width of a pixel."""
    touching = solved.bends.squared.copy()
    touching.data = np.ones_like(touching.data)
    bend = solved.bends.of_heights @ solved.height
    bends = (touching @ (bend * bend)) / np.maximum(np.diff(touching.indptr), 1)
    highest, lowest = np.full((2, *tile.inside.shape), [[[-np.inf]], [[np.inf]]], dtype=np.float32)
    highest[tile.inside] = lowest[tile.inside] = solved.height
    span = ndimage.maximum_filter(highest, 3)[tile.inside] - ndimage.minimum_filter(lowest, 3)[tile.inside]
    return bends + (_PLACE_PX * 0.5 * span) ** 2


def shift_of(samples: list[tuple[Tile, Solved]], roughness: float, pool: Executor) -> float:
    """By how many pixels the photographs are shifted against each other beyond what their noise explains.

    Each half of the photographs gives heights of its own. Their differences are compared with those that noise as
    large as the residuals, independent from pixel to pixel and from photograph to photograph, would give; waves, errors
    of the poses and a noise that neighbours share make them larger. Zero where too few pixels are seen by both halves.
    """
    found = list(pool.map(lambda each: _differences(each[0], each[1], roughness), samples))
    seen, of_noise, per_pixel = (np.concatenate(column) for column in zip(*found, strict=True))
    if len(seen) < _LEAST_PIXELS:
        return 0.0
    large, of_noise_large = (np.quantile(np.abs(each), _SHARE) for each in (seen, of_noise))
    beyond = (large**2 - of_noise_large**2) / _WITHIN**2
    return float(np.sqrt(max(beyond, 0.0) / np.median(per_pixel)))


def _differences(tile: Tile, solved: Solved, roughness: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Between the heights of both halves of the photographs: as found, and as drawn from the noise [m].

    Third, their variance for shifts of one pixel [m^2]. Pixels of which one half knows next to nothing are left out: it
    would repeat what both say together.
    """
    random, found, drawn, halves = np.random.default_rng(0), [], [], halves_of(solved)
    known = [_nearby(tile, half.information) > _OWN_SHARE * _nearby(tile, solved.information) for half in halves]
    for half in halves:
        height = heights_of(solved, half, roughness)
        stiffness = stiffness_of(solved.bends.of_heights @ height, roughness)
        noise = np.sqrt(half.information) * random.standard_normal(len(tile)).astype(np.float32)
        diagonal = half.information + solved.bends.squared @ stiffness + FAINT
        found.append(height)
        drawn.append(conjugate_gradients(normal_matrix(half.information, solved.bends, stiffness), noise, diagonal))
    use = tile.asked & known[0] & known[1]
    per_pixel = 1.0 / halves[0].parallax + 1.0 / halves[1].parallax
    return (found[0] - found[1])[use], (drawn[0] - drawn[1])[use], per_pixel[use]


def _nearby(tile: Tile, values: np.ndarray) -> np.ndarray:
    """Mean of values (N,) around each pixel of the tile."""
    total, weight = (_spread(tile, part) for part in (values, np.ones(len(tile))))
    return total / np.maximum(weight, 1e-9)


def _spread(tile: Tile, values: np.ndarray) -> np.ndarray:
    image = np.zeros(tile.inside.shape)
    image[tile.inside] = values
    return ndimage.gaussian_filter(image, _ALIKE_PX)[tile.inside]


@cache
def _shares() -> tuple[list[float], list[float]]:
    """Logarithms of the mean over all waves of ``1 / (1 + ratio S)``, and of its square, for `_RATIOS`."""
    angle = 2.0 * np.pi * np.fft.fftfreq(_FREQUENCIES)
    along = 2.0 - 2.0 * np.cos(angle)
    symbol = (along[:, None] + along) ** 2
    once, twice = ([np.log(((1.0 / (1.0 + r * symbol)) ** power).mean()) for r in _RATIOS] for power in (1, 2))
    return once, twice
