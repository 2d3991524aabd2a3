"""Which pixels keep the height of the sweep: where it is the better one, by what noise does to both."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np

from fields.solver.correlation import NoiseShares
from fields.solver.smoothness import stiffness_of
from fields.solver.solve import Solved
from fields.solver.tile import Tile
from fields.solver.uncertainty import expected_of
from fields.sweep.slopes import gradient_of

# Noise alone makes one pixel in a billion as steep as this many standard deviations, or some more: its tails are long.
_SIGNIFICANT = 6.0
# Of normally distributed values, so many lie within so many standard deviations.
_MOST, _WITHIN = 0.95, 1.96
# Heights of the sweep come from windows of this side. Noise makes the photographs agree on nine heights that follow it
# better than on the true ones by more than this logarithm in one window of a thousand (chi-square, nine degrees).
_WINDOW_PX, _REFUTED = 3, 0.5 * 27.9
# Photographs that tell a height: its own shows no change of it.
_FEWEST = 2


def keeps_sweep(
    tile: Tile, solved: Solved, by_noise: np.ndarray, noise: NoiseShares, slopes: float, tolerance: float
) -> np.ndarray:
    """Which pixels (N,) bool of a solved tile keep the height of the sweep.

    Those that look along a wall or over an edge: there a pixel shows so long a piece of the bed that the other
    photographs do not look like it, and the prior alone would move its height. Their rise from pixel to pixel is above
    the tolerance of agreement [m], and above what noise makes of level ones: ``by_noise`` (N,) [m^2] is its variance in
    a solved height, ``slopes`` as `slopes_by_noise` gives it. And those about which the photographs agree better at the
    height of the sweep, by more than noise explains, or say nothing, because under glint all but one lost their weight.
    """
    steep = solved.start.slope > np.maximum(tolerance, _SIGNIFICANT * slopes * np.sqrt(by_noise))
    image = np.zeros(tile.inside.shape, dtype=np.float32)
    image[tile.inside] = solved.gain
    side = (_WINDOW_PX, _WINDOW_PX)
    window = cv2.boxFilter(image, -1, side, normalize=False, borderType=cv2.BORDER_CONSTANT)[tile.inside]
    # Noise that neighbours share counts several times in a sum over pixels.
    silent = np.count_nonzero(solved.brightness.weight > 0.0, axis=0) < _FEWEST
    return steep | silent | (window < -_REFUTED * max(noise.heights, 1.0))


def slopes_by_noise(samples: list[tuple[Tile, Solved]], roughness: float, noise: NoiseShares) -> float:
    """Standard deviation of the slopes that the noise of the sweep has, against that of a solved height by noise.

    By how far the solver moved the heights of samples, which is mostly noise of the sweep; walls and edges are few. A
    factor of the survey (0.9 on data/quick, 3 in blur of 4 px).
    """
    found = []
    for tile, each in samples:
        moved = np.zeros(tile.inside.shape, dtype=np.float32)
        moved[tile.inside] = each.height - each.start.height
        whole = cv2.erode(tile.inside.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0)[tile.inside] > 0
        solved = replace(each, stiffness=stiffness_of(each.bends.of_heights @ each.height, roughness))
        by_noise = noise.heights * expected_of(tile, solved, noise.response).noise
        found += [np.abs(rise[tile.inside][whole]) / np.sqrt(by_noise[whole]) for rise in gradient_of(moved)]
    together = np.concatenate(found)
    return float(np.quantile(together, _MOST)) / _WITHIN if len(together) else 1.0
