"""How rough the bed is at small scale against large scale, as the solved heights have it.

The prior takes from the bed what is as fine as noise, or finer. How much that is follows from what smoothing the
heights once more changes only with the power of the bed at small scale against that at large scale. What smoothing that
change changes of it in turn tells it: the rougher the bed at small scale, the more. Both are made with the normal
matrix itself, whose information differs from pixel to pixel, so that what a uniform one lets expect is wrong of both
alike.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fields.solver.correlation import phantom_of
from fields.solver.smoothness import stiffness_of
from fields.solver.solve import CG_RESIDUAL, Solved
from fields.solver.tile import Tile
from fields.solver.uncertainty import ONE_STD, answer_of, change_of, smoothed
from fields.solver.waves import FALL_OF_PRIOR, means_at

# Exponents that beds may have, and how far they differ from that of the prior.
_FALLS, _BEDS_DIFFER = np.linspace(0.5, 1.5, 21), 0.25
# Phantoms have the noise of changes to this share of it, besides chance.
_NOISE_KNOWN = 0.03
# Fewer pixels tell nothing.
_LEAST_PIXELS = 2000


def fall_of(samples: list[tuple[Tile, Solved]], roughness: float, response: float) -> float:
    """How steeply the bed's power falls with the frequency: the exponent of `fields.solver.waves`.

    Parameters
    ----------
    samples : solved tiles, with the stiffness of any roughness
    roughness : [m]
        With which the survey is solved.
    response : float
        How much of the information the residuals answer with.
    """
    parts = [_changes_of(tile, solved, roughness, response) for tile, solved in samples]
    squares, log_ratio = (np.concatenate(each, axis=-1) for each in zip(*parts, strict=True))
    if len(log_ratio) < _LEAST_PIXELS:
        return FALL_OF_PRIOR
    # Steps and edges do not move the rest.
    power, by_noise = np.quantile(squares, ONE_STD, axis=-1)
    middle = float(np.median(log_ratio))
    chance = np.sqrt(2.0 * means_at(middle, FALL_OF_PRIOR).alike / len(log_ratio))
    known = np.hypot(chance * power, np.hypot(chance, _NOISE_KNOWN) * by_noise)
    rest, costs = (power - by_noise) / known, []
    for fall in _FALLS:
        means = means_at(middle, float(fall))
        relief = np.array([means.changed_relief, means.twice_changed_relief]) / known
        size = max(float(relief @ rest / (relief @ relief)), 0.0)
        left = rest - size * relief
        costs.append(left @ left + ((fall - FALL_OF_PRIOR) / _BEDS_DIFFER) ** 2)
    return float(_FALLS[int(np.argmin(costs))])


def _changes_of(tile: Tile, solved: Solved, roughness: float, response: float) -> tuple[np.ndarray, np.ndarray]:
    """Squares (2, 2, N) [m^2] of what smoothing once and twice more changes, of the heights of a roughness and of a
    phantom, and the logarithm (N,) of the ratio of stiffness to answer."""
    solved = replace(solved, stiffness=stiffness_of(solved.bends.of_heights @ solved.height, roughness))
    brightness = solved.brightness
    pull = np.einsum("kn,kn,kn->n", brightness.weight, solved.slope, brightness.residual)
    right = -pull - solved.bends.pull(solved.stiffness, solved.height)
    height = solved.height + smoothed(solved, right, response, CG_RESIDUAL)
    _, phantom, known = phantom_of(solved, response)
    use, changes = known & tile.asked, []
    for each in (height, phantom):
        once = change_of(solved, each, response)
        changes.append((once, change_of(solved, once, response)))
    return np.square(np.array(changes)[..., use]), answer_of(tile, solved, response)[1][use]
