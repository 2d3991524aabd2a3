"""How rough the bed is at small scale against large scale, as the solved heights have it.

The prior takes from the bed what is as fine as noise, or finer. How much that is follows from what is left only with
the power of the bed at small scale against that at large scale. Heights in bands of an octave each, less their noise,
tell it where photographs resolve the bed; it is taken to go on below.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import cv2
import numpy as np

from fields.solver.correlation import NoiseShares
from fields.solver.smoothness import stiffness_of
from fields.solver.solve import CG_RESIDUAL, Solved
from fields.solver.tile import Tile
from fields.solver.uncertainty import ONE_STD, answer_of, smoothed
from fields.solver.waves import BELLS_PX, FALL_OF_PRIOR, bands_at

# From beds that are as rough below the pixel as above it to those of the prior: none is smoother for sure, since what
# is finer than the finest band shows nowhere.
_FALLS = np.linspace(0.5, FALL_OF_PRIOR, 11)
# How far the noise of a band and the power in it are known, as a share of them; and how far beds differ from the prior.
_NOISE_KNOWN, _BAND_KNOWN, _BEDS_DIFFER = 0.15, 0.1, 0.25
# Pixels so near to the rim of a tile are left out, and fewer than so many tell nothing.
_RIM_PX, _LEAST_PIXELS = 4, 2000


def fall_of(samples: list[tuple[Tile, Solved]], roughness: float, noise: NoiseShares) -> float:
    """How steeply the bed's power falls with the frequency: the exponent of `fields.solver.waves`.

    Parameters
    ----------
    samples : solved tiles, with the stiffness of any roughness
    roughness : [m]
        With which the survey is solved.
    noise : NoiseShares
    """
    parts = [_bands_of(tile, solved, roughness, noise) for tile, solved in samples]
    squares, by_noise, ratios = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    if len(ratios) < _LEAST_PIXELS:
        return FALL_OF_PRIOR
    # Steps and edges do not move the rest.
    power, middle = np.quantile(squares, ONE_STD, axis=-1), float(np.median(ratios))
    of_noise = np.median(by_noise, axis=-1) * bands_at(middle, FALL_OF_PRIOR)[0]
    known = np.hypot(_NOISE_KNOWN * of_noise, _BAND_KNOWN * power)
    costs = []
    for fall in _FALLS:
        relief = bands_at(middle, float(fall))[1] / known
        rest = (power - of_noise) / known
        size = max(float(relief @ rest / (relief @ relief)), 0.0)
        left = rest - size * relief
        costs.append(left @ left + ((fall - FALL_OF_PRIOR) / _BEDS_DIFFER) ** 2)
    return float(_FALLS[int(np.argmin(costs))])


def _bands_of(
    tile: Tile, solved: Solved, roughness: float, noise: NoiseShares
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squares (bands, N) [m^2] of the heights of a roughness, the variance (1, N) [m^2] that a height has by noise
    where neighbours do not hold it, and the logarithm (N,) of the ratio of stiffness to answer."""
    solved = replace(solved, stiffness=stiffness_of(solved.bends.of_heights @ solved.height, roughness))
    brightness = solved.brightness
    pull = np.einsum("kn,kn,kn->n", brightness.weight, solved.slope, brightness.residual)
    right = -pull - solved.bends.pull(solved.stiffness, solved.height)
    height = solved.height + smoothed(solved, right, noise.response, CG_RESIDUAL)
    answer, log_ratio = answer_of(tile, solved, noise.response)
    around = np.ones((2 * _RIM_PX + 1,) * 2, dtype=np.uint8)
    within = cv2.erode(tile.inside.astype(np.uint8), around)[tile.inside].astype(bool) & tile.asked
    bells = [_bell(tile, height, bell) for bell in BELLS_PX]
    squares = np.stack([(fine - coarse)[within] ** 2 for fine, coarse in pairwise(bells)])
    return squares, (noise.heights / (noise.response * answer))[None, within], log_ratio[within]


def _bell(tile: Tile, heights: np.ndarray, std_px: float) -> np.ndarray:
    """Heights (N,) averaged in a bell, of those that the tile has."""
    if std_px == 0.0:
        return heights
    both = np.zeros((*tile.inside.shape, 2), dtype=np.float32)
    both[tile.inside] = np.stack([heights, np.ones_like(heights)], axis=-1)
    total, weight = cv2.split(cv2.GaussianBlur(both, (0, 0), std_px))
    return (total / np.maximum(weight, 1e-6))[tile.inside]
