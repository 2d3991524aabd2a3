"""What the solver does to waves of the heights, each on its own: means over all waves of a bed of equal pixels.

With information H of a height, of which the residuals answer with ``A = response * H``, and stiffness q, a wave of the
bed is multiplied by ``A / (A + q S)``, with S the square of the symbol of Laplace's operator: the power that the prior
expects of the bed is ``1 / (q S)``. Beds of another roughness at small than at large scale have ``1 / S**fall``. All
depends on the ratio of q to A alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np

# How steeply the bed's power falls with the frequency, as an exponent of what the prior expects.
FALL_OF_PRIOR = 1.0
_FREQUENCIES, _RATIOS = 256, np.logspace(-4.0, 9.0, 66)


@dataclass(frozen=True)
class Means:
    """Means over all waves at some ratios (N,) of stiffness to answer.

    Attributes
    ----------
    noise, relief : (N,)
        Of the noise of a height, and of the relief that the prior takes from it.
    changed_noise, changed_relief : (N,)
        Of both in what smoothing a height once more changes.
    twice_changed_relief : (N,)
        Of relief in what smoothing that change changes of it.
    bends_noise : (N,)
        Of noise in the bends about a height.
    alike : (N,) [px^2]
        How many pixels share a value of what is changed.
    """

    noise: np.ndarray
    relief: np.ndarray
    changed_noise: np.ndarray
    changed_relief: np.ndarray
    twice_changed_relief: np.ndarray
    bends_noise: np.ndarray
    alike: np.ndarray


def means_at(log_ratio: np.ndarray | float, fall: float) -> Means:
    """Means for logarithms (N,) of the ratio of stiffness to answer, and a bed whose power falls so steeply."""
    return Means(*(np.exp(np.interp(log_ratio, np.log(_RATIOS), row)) for row in _shares(fall)))


@cache
def _symbols() -> tuple[np.ndarray, np.ndarray]:
    """Of the square of Laplace's operator, and of the bends of a height."""
    angle = 2.0 * np.pi * np.fft.fftfreq(_FREQUENCIES)
    along = 2.0 - 2.0 * np.cos(angle)
    # Of the ten bends of a height three are along rows, three along columns and four across both.
    bend = 0.3 * (along[:, None] ** 2 + along**2) + 0.8 * along[:, None] * along
    return (along[:, None] + along) ** 2, bend


def _power(fall: float) -> np.ndarray:
    """Of the bed; what is the same everywhere is no relief."""
    symbol, _ = _symbols()
    return np.where(symbol > 0.0, np.maximum(symbol, 1e-30) ** -fall, 0.0)


@cache
def _shares(fall: float) -> np.ndarray:
    """Logarithms of `Means` (7, ratios)."""
    symbol, bend = _symbols()
    power, rows = _power(fall), []
    for ratio in _RATIOS:
        kept = 1.0 / (1.0 + ratio * symbol)
        # What the prior expects of the bed at that ratio, if it falls as the prior has it.
        noise, relief = kept**2, (1.0 - kept) ** 2 * power / ratio
        changed = (1.0 - kept) ** 2 * noise
        changed_relief, alike = relief * kept**2, (changed**2).mean() / changed.mean() ** 2
        twice = changed_relief * (1.0 - kept) ** 2
        means = (part.mean() for part in (noise, relief, changed, changed_relief, twice, bend * noise))
        rows.append([*means, alike])
    return np.log(rows).T
