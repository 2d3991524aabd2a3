"""Phase congruency: where the waves that make up an image are in step, there is an edge or a corner, dark or bright."""

from __future__ import annotations

import math

import numpy as np

# The parameters with which FSIM uses it: Zhang et al. 2011, section IV-A, and the code of P. Kovesi that it names.
_SCALES, _ORIENTATIONS = 4, 4
_SHORTEST_PX, _STEP, _BANDWIDTH = 6.0, 2.0, 0.55
_ANGLE_SPREAD = math.pi / (_ORIENTATIONS * 1.2)
_CUTOFF, _ORDER = 0.45, 15
# Energy below the noise's mean plus this many of its standard deviations counts as zero; the divisor of that limit.
_NOISE_STDS, _NOISE_SHARE = 2.0, 1.7


def phase_congruency(image: np.ndarray) -> np.ndarray:
    """Phase congruency (H, W), 0 to 1, of an image (H, W).

    Notes
    -----
    P. Kovesi, Image features from phase congruency, Videre 1 (1999), with the noise taken from the median response at
    the finest scale. Each orientation gives the sum over scales of ``A (cos d - |sin d|)``, A the amplitude and d the
    difference of its phase from the mean, less the noise; the sum of those over the sum of all amplitudes is the phase
    congruency.
    """
    radius, angle = _polar_frequencies(image.shape)
    radial = [log_gabor(radius, 1.0 / (_SHORTEST_PX * _STEP**s), _BANDWIDTH) for s in range(_SCALES)]
    low_pass = 1.0 / (1.0 + (radius / _CUTOFF) ** (2 * _ORDER))
    spectrum = np.fft.fft2(image)
    energy, amplitudes = np.zeros(image.shape), np.full(image.shape, np.finfo(float).eps)
    for orientation in range(_ORIENTATIONS):
        off = angle - orientation * math.pi / _ORIENTATIONS
        spread = np.exp(-(np.arctan2(np.sin(off), np.cos(off)) ** 2) / (2.0 * _ANGLE_SPREAD**2))
        filters = np.stack([r * low_pass * spread for r in radial])
        response = np.fft.ifft2(spectrum * filters)
        total = response.sum(axis=0)
        unit = total / (np.abs(total) + np.finfo(float).eps)
        # Real part: along the mean phase; imaginary part: across it.
        turned = response * unit.conj()
        energy += np.maximum((turned.real - np.abs(turned.imag)).sum(axis=0) - _noise(response[0], filters), 0.0)
        amplitudes += np.abs(response).sum(axis=0)
    return energy / amplitudes


def log_gabor(radius: np.ndarray, centre: float, spread: float) -> np.ndarray:
    """Gaussian over the logarithm of the frequency, without direct current; frequencies in cycles per pixel.

    ``spread`` is the ratio of the standard deviation to the centre, in logarithms.
    """
    safe = np.where(radius > 0.0, radius, 1.0)
    return np.where(radius > 0.0, np.exp(-(np.log(safe / centre) ** 2) / (2.0 * math.log(spread) ** 2)), 0.0)


def _polar_frequencies(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Frequency [cycles per pixel] and angle (counter-clockwise, rows down) of each term of a spectrum."""
    down, across = np.meshgrid(*(np.fft.fftfreq(n) for n in shape), indexing="ij")
    return np.hypot(across, down), np.arctan2(-down, across)


def _noise(finest: np.ndarray, filters: np.ndarray) -> float:
    """Energy that noise alone would show; its power is taken from the median response at the finest scale."""
    power = np.median(np.abs(finest) ** 2) / math.log(2.0) / np.sum(filters[0] ** 2)
    # Terms of one filter and of pairs of them together are the square of their sum.
    shapes = np.fft.ifft2(filters).real.sum(axis=0)
    tau = math.sqrt(power * float(np.sum(shapes**2)) * filters[0].size)
    mean, std = tau * math.sqrt(math.pi / 2.0), tau * math.sqrt(2.0 - math.pi / 2.0)
    return (mean + _NOISE_STDS * std) / _NOISE_SHARE
