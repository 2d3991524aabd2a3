"""What the variance by noise is worth: noise that neighbouring pixels share moves a height more than independent noise.

Blurred, compressed or demosaiced photographs have such noise, and photographs that are interpolated have less of it
than their pixels. The normal matrix counts each pixel for itself. Contrasts between the photographs of a survey, in
which neither albedo nor height takes part, show how much more or less the sum over neighbouring pixels varies.
"""

from __future__ import annotations

import numpy as np
from scipy.fft import irfft2, rfft2

from fields.solver.solve import Solved
from fields.solver.tile import Tile

# Noise is shared over so many pixels; what is alike from there to the second distance is a shift of photographs
# against each other, which `fields.solver.shifts` measures.
NEAR_PX, FAR_PX = 3.2, 9.0
# Contrasts larger than this many times their standard deviation come from something else than noise.
_LARGEST = 6.0
# Fewer pixels tell nothing.
_LEAST_PIXELS = 2000
_CONTRASTS = 2
# Of the information: a pixel whose contrast has less does not speak; nor is any noise so much smaller than it seems.
_LEAST_SHARE = 0.05


def noise_share(samples: list[tuple[Tile, Solved]]) -> float:
    """Factor on the variance by noise and prior; one where fewer than three photographs see too many of the samples.

    It is the sum of the autocovariance of contrasts over a neighbourhood, in units of the variance that the weights of
    single pixels give them. For the smoothness that suits the noise the whole variance of a height grows with it, since
    what is lost by smoothing does too.
    """
    reach = int(FAR_PX)
    products, pairs = np.zeros((2, 2 * reach + 1, 2 * reach + 1))
    for tile, solved in samples:
        for number in range(_CONTRASTS):
            contrast, known = _contrast(solved, np.random.default_rng(number))
            products = products + _correlation(tile, contrast)
            pairs = pairs + _correlation(tile, known.astype(np.float32))
    lag = np.arange(-reach, reach + 1)
    distance = np.hypot(lag, lag[:, None])
    if pairs.max() < _LEAST_PIXELS * _CONTRASTS:
        return 1.0
    covariance = products / np.maximum(pairs, 1.0)
    far = covariance[(distance > 2.0 * NEAR_PX) & (distance <= FAR_PX)].mean()
    return float(max((covariance - far)[distance <= NEAR_PX].sum(), _LEAST_SHARE))


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


def _correlation(tile: Tile, values: np.ndarray) -> np.ndarray:
    """Sums of products of values (N,) with those of pixels up to `FAR_PX` away, across and down, as a square image."""
    reach = int(FAR_PX)
    image = np.zeros([size + reach for size in tile.inside.shape])
    image[: tile.inside.shape[0], : tile.inside.shape[1]][tile.inside] = values
    products = irfft2(np.abs(rfft2(image)) ** 2, image.shape)
    lag = np.arange(-reach, reach + 1)
    return products[np.ix_(lag, lag)]
