"""What the variance by noise and prior is worth, learned at twice the ground sampling distance.

There the solved heights are a truth that is finer than the pixel. Photographs of half the size, with noise added until
they are as noisy as before, are solved again, and the errors against the heights of the whole size tell how much the
normal matrix says too much or too little: the prior is not the bed, robust weights and interpolated photographs are
not what it takes them for. All of that is alike at both scales. What is lost below the pixel is not: its share is
found with that of the noise but not carried over (docs/field.md).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.optimize import minimize

from fields.sweep.sweep import DepthMap
from refract import PinholeCamera

# Degrees of freedom of Student's law in the fit: tails as long as those of errors at edges. 95 % of them lie within
# 2.447 of its scale, 95 % of normal ones within 1.96 standard deviations.
_TAILS = 6.0
_TO_NORMAL = (2.447 / 1.96) ** 2
# Errors that decide, and the least that the fit needs.
MOST_ERRORS, LEAST_ERRORS = 6000, 500
_LOGARITHMS = (-5.0, 4.0)
# So many neighbouring errors say the same; beforehand the variance of Student's law is what the parts say, to a factor
# of e.
_ALIKE, _BEFORE = 25.0, float(np.log((_TAILS - 2.0) / _TAILS))


def for_few(views: np.ndarray) -> np.ndarray:
    """Factor (N,) on the variance of heights on which so many photographs agree.

    What is particular to a place (a reflection, an edge that hides it) is known from those photographs alone: Student's
    law of one degree of freedom more than there are photographs.
    """
    count = np.maximum(views.astype(np.float32), 2.0)
    return (count + 1.0) / (count - 1.0)


def noise_share(error: np.ndarray, noise: np.ndarray, bends: np.ndarray, views: np.ndarray) -> float:
    """Factor on the variance by noise and prior with which errors are as large as it says; one if they are too few.

    Parameters
    ----------
    error : (N,) [m]
        At twice the ground sampling distance.
    noise, bends : (N,) [m^2]
        Variance by noise and prior, and of the bed below the pixel, as they are there.
    views : (N,)
        Photographs that agree.
    """
    if len(error) < LEAST_ERRORS:
        return 1.0
    some = np.random.default_rng(0).permutation(len(error))[:MOST_ERRORS]
    parts = np.stack([noise[some], bends[some]]) * for_few(views[some])
    square = error[some].astype(np.float64) ** 2

    def cost(logarithms: np.ndarray) -> float:
        variance = np.exp(logarithms) @ parts
        likelihood = np.mean(np.log(variance) + (_TAILS + 1.0) * np.log1p(square / (_TAILS * variance)))
        beside = logarithms - _BEFORE
        return float(likelihood + _ALIKE * (beside @ beside) / len(square))

    found = minimize(cost, np.full(2, _BEFORE), method="L-BFGS-B", bounds=[_LOGARITHMS] * 2).x
    return float(_TO_NORMAL * np.exp(found[0]))


def halved(image: np.ndarray) -> np.ndarray:
    """Means of squares of two by two pixels; an odd last row or column is left out."""
    rows, columns = (size // 2 for size in image.shape)
    return image[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2).mean(axis=(1, 3))


def halved_camera(camera: PinholeCamera) -> PinholeCamera:
    """The camera of a halved image."""
    return replace(camera, width=camera.width // 2 * 2, height=camera.height // 2 * 2).scaled(0.5)


def halved_map(depth_map: DepthMap) -> DepthMap:
    """A height map of half the size; a pixel is confirmed where all four are."""
    confirmed = halved((depth_map.agreeing > 0).astype(np.float32)) == 1.0
    return DepthMap(
        depth_map.view,
        halved(depth_map.height),
        halved(depth_map.score),
        (confirmed * halved(depth_map.agreeing)).astype(np.uint8),
        halved(depth_map.spread),
    )


def as_noisy(image: np.ndarray, noise: float, random: np.random.Generator) -> np.ndarray:
    """A halved image with its noise [grey levels] restored: the mean of four pixels has half of theirs."""
    added = random.standard_normal(image.shape, dtype=np.float32)
    return (image + np.float32(np.sqrt(0.75) * noise) * added).astype(np.float32)
