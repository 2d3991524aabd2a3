"""How sure a height is, by the normal matrix and by the relief below the pixel."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy import ndimage

from fields.solver.solve import FAINT, Solved
from fields.solver.tile import Tile

# Information and stiffness are alike over about the range in which heights are correlated [px].
_ALIKE_PX = 1.5
# A point lies anywhere in its pixel: the variance of its place along each axis [px^2].
PLACE_PX2 = 1.0 / 12.0
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


def bends_below(solved: Solved) -> np.ndarray:
    """Variance (N,) [m^2] of the bed within a pixel by how it bends there."""
    touching = solved.bends.squared.copy()
    touching.data = np.ones_like(touching.data)
    bend = solved.bends.of_heights @ solved.height
    return (touching @ (bend * bend)) / np.maximum(np.diff(touching.indptr), 1)


def rise_of(tile: Tile, height: np.ndarray) -> np.ndarray:
    """Rise (N,) [m/px] of heights (N,) [m] over the pixels next to each."""
    highest, lowest = np.full((2, *tile.inside.shape), [[[-np.inf]], [[np.inf]]], dtype=np.float32)
    highest[tile.inside] = lowest[tile.inside] = height
    return 0.5 * (ndimage.maximum_filter(highest, 3)[tile.inside] - ndimage.minimum_filter(lowest, 3)[tile.inside])


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
