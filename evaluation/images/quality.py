"""Image quality measures: PSNR, SSIM, MS-SSIM, GMSD, MS-GMSD, FSIM, VSI; no network and no weights.

LPIPS and DISTS are in `evaluation.images.learned_similarity`. Images are (H, W) or (H, W, 3), 0 to 1.

The measures are written out here, after the equations of their papers, rather than taken from a library:

- torchmetrics 1.9 has PSNR, SSIM and MS-SSIM of them. Its SSIM averages windows that reach beyond the image as well,
  where it mirrors the image, and the paper only those inside: 0.002 apart on the test image, equal to 1e-12 over the
  windows inside, as a test checks. Its PSNR is equal to 1e-6 dB (a sum in float32). On a CPU its SSIM takes about forty
  times as long.
- piq 0.8 has all of them, but requires torchvision in the version that fits torch, which none of these needs. Tests
  have its values for the test images: equal to 1e-12 for SSIM, MS-SSIM, GMSD and MS-GMSD, 3e-6 for FSIM, 1e-4 for VSI.

FSIM (phase congruency) and VSI (visual saliency) are computed on images whose shorter side is about 256 pixels: larger
ones are averaged over blocks of pixels first. Phase congruency is high where the Fourier components of an image are in
phase: at edges and corners, dark or bright.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial

import cv2
import numpy as np
from scipy import ndimage

from evaluation.images.inputs import (
    PREWITT,
    SCHARR,
    block_means,
    checked_pair,
    gradient,
    largest_rectangle,
    similarity,
    yiq,
)

_SIDE_PX = 256
# FSIM, Zhang et al. 2011, section IV-A: of phase congruency, gradients and colour; exponent of colour.
_T1, _T2, _T3, _LAMBDA = 0.85, 160.0, 200.0, 0.03
# VSI, Zhang et al. 2014, table II: of saliency, gradients and colour; exponents of gradients and colour.
_VSI_C1, _VSI_C2, _C3, _ALPHA, _BETA = 1.27, 386.0, 130.0, 0.40, 0.02
# Its saliency: frequency and spread of the band-pass, spread of the centre [px] and of colour.
_OMEGA, _SIGMA_F, _SIGMA_D, _SIGMA_C = 0.021, 1.34, 145.0, 0.001
# Opponent colours L, M, N (Geusebroek et al. 2001), as VSI has them.
_LMN = np.array([[0.06, 0.63, 0.27], [0.30, 0.04, -0.35], [0.34, -0.60, 0.17]])
# The parameters with which FSIM uses it: Zhang et al. 2011, section IV-A, and the code of P. Kovesi that it names.
_SCALES, _ORIENTATIONS = 4, 4
_SHORTEST_PX, _STEP, _BANDWIDTH = 6.0, 2.0, 0.55
_ANGLE_SPREAD = math.pi / (_ORIENTATIONS * 1.2)
_CUTOFF, _ORDER = 0.45, 15
# Energy below the noise's mean plus this many of its standard deviations counts as zero; the divisor of that limit.
_NOISE_STDS, _NOISE_SHARE = 2.0, 1.7


def fsim(reference: np.ndarray, image: np.ndarray) -> float:
    """Feature similarity, with its term for colour (FSIMc) of colour images; 1 for equal images.

    Notes
    -----
    L. Zhang, L. Zhang, X. Mou, D. Zhang, FSIM: a feature similarity index for image quality assessment, IEEE
    Transactions on Image Processing 20 (2011), equations 5 to 11. Pixels count by the larger phase congruency.
    """
    pair = checked_pair(reference, image, smallest=16)
    size = _pool_size(pair[0])
    x, y = (block_means(yiq(255.0 * v), size) for v in pair)
    pc_x, pc_y = phase_congruency(x[0]), phase_congruency(y[0])
    score = similarity(pc_x, pc_y, _T1) * similarity(gradient(x[0], SCHARR), gradient(y[0], SCHARR), _T2)
    if len(x) == 3:
        # The power of a negative product is complex; its magnitude is taken.
        score = score * np.abs(similarity(x[1], y[1], _T3) * similarity(x[2], y[2], _T3)) ** _LAMBDA
    weight = np.maximum(pc_x, pc_y)
    # Two images without any feature are alike.
    return float((score * weight).sum() / weight.sum()) if weight.any() else 1.0


def vsi(reference: np.ndarray, image: np.ndarray) -> float:
    """Visual saliency induced index of two colour images (H, W, 3); 1 for equal images.

    Notes
    -----
    L. Zhang, Y. Shen, H. Li, VSI: a visual saliency-induced index for perceptual image quality assessment, IEEE
    Transactions on Image Processing 23 (2014), equations 6 to 10. Pixels count by the larger saliency.
    """
    pair = checked_pair(reference, image, smallest=16)
    if pair[0].ndim != 3:
        raise ValueError("VSI needs colour images, got grey ones; use fsim or gmsd")
    size = _pool_size(pair[0])
    vs_x, vs_y = (block_means(_saliency(v), size) for v in pair)
    x, y = (block_means(np.einsum("cd,hwd->chw", _LMN, 255.0 * v), size) for v in pair)
    gradients = similarity(gradient(x[0], SCHARR), gradient(y[0], SCHARR), _VSI_C2)
    colour = similarity(x[1], y[1], _C3) * similarity(x[2], y[2], _C3)
    # The real part of the complex power where the product is negative.
    powered = np.abs(colour) ** _BETA * np.where(colour < 0.0, np.cos(np.pi * _BETA), 1.0)
    score = similarity(vs_x, vs_y, _VSI_C1) * gradients**_ALPHA * powered
    weight = np.maximum(vs_x, vs_y)
    return float((score * weight).sum() / weight.sum()) if weight.any() else 1.0


def _saliency(image: np.ndarray) -> np.ndarray:
    """Saliency (H, W), 0 to 1: by a band of frequencies, distance from the centre, and colour.

    L. Zhang, Z. Gu, H. Li, SDSP: a novel saliency detection method by combining simple priors, ICIP (2013).
    """
    height, width = image.shape[:2]
    small = cv2.resize(image, (_SIDE_PX, _SIDE_PX), interpolation=cv2.INTER_LINEAR)
    lab = cv2.cvtColor(small.astype(np.float32), cv2.COLOR_RGB2Lab).astype(np.float64)
    along = np.fft.fftfreq(_SIDE_PX)
    radius = np.hypot(*np.meshgrid(along, along))
    band = np.where(radius <= 0.5, log_gabor(radius, _OMEGA, np.exp(_SIGMA_F)), 0.0)
    passed = np.fft.ifft2(np.fft.fft2(lab, axes=(0, 1)) * band[..., None], axes=(0, 1)).real
    frequency = np.linalg.norm(passed, axis=2)
    from_centre = np.arange(_SIDE_PX) - _SIDE_PX // 2 + 1.0
    central = np.exp(-np.add.outer(from_centre**2, from_centre**2) / _SIGMA_D**2)
    a_b = _stretched(lab, axis=(0, 1))[..., 1:]
    coloured = 1.0 - np.exp(-(a_b**2).sum(axis=2) / _SIGMA_C**2)
    return _stretched(_resized(frequency * central * coloured, height, width))


def _resized(image: np.ndarray, height: int, width: int) -> np.ndarray:
    """An image resized bilinearly, with corner pixels kept on the corners."""
    rows, columns = (np.linspace(0.0, n - 1.0, m) for n, m in zip(image.shape, (height, width), strict=True))
    at_columns, at_rows = np.meshgrid(columns.astype(np.float32), rows.astype(np.float32))
    return cv2.remap(image, at_columns, at_rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _stretched(values: np.ndarray, axis=None) -> np.ndarray:
    """Values rescaled to 0 to 1 along axes; 0 where all are equal."""
    low, high = values.min(axis=axis, keepdims=True), values.max(axis=axis, keepdims=True)
    return (values - low) / np.where(high > low, high - low, 1.0)


def _pool_size(image: np.ndarray) -> int:
    return max(1, round(min(image.shape[:2]) / _SIDE_PX))


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
    """Log-Gabor filter: Gaussian over the logarithm of the frequency [cycles per pixel], zero at frequency zero.

    ``spread`` is the ratio of the standard deviation to the centre, in logarithms.
    """
    safe = np.where(radius > 0.0, radius, 1.0)
    return np.where(radius > 0.0, np.exp(-(np.log(safe / centre) ** 2) / (2.0 * math.log(spread) ** 2)), 0.0)


def _polar_frequencies(shape: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Frequency [cycles per pixel] and angle (counter-clockwise, rows down) of each term of a spectrum."""
    down, across = np.meshgrid(*(np.fft.fftfreq(n) for n in shape), indexing="ij")
    return np.hypot(across, down), np.arctan2(-down, across)


def _noise(finest: np.ndarray, filters: np.ndarray) -> float:
    """Energy expected of noise alone, whose power is taken from the median response at the finest scale."""
    power = np.median(np.abs(finest) ** 2) / math.log(2.0) / np.sum(filters[0] ** 2)
    # Squares of filters plus products of their pairs are the square of their sum.
    shapes = np.fft.ifft2(filters).real.sum(axis=0)
    tau = math.sqrt(power * float(np.sum(shapes**2)) * filters[0].size)
    mean, std = tau * math.sqrt(math.pi / 2.0), tau * math.sqrt(2.0 - math.pi / 2.0)
    return (mean + _NOISE_STDS * std) / _NOISE_SHARE


# Wang et al. 2004: Gaussian window and the constants that keep quotients finite.
_WINDOW_PX, _SIGMA_PX = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
# Wang et al. 2003, five scales.
_MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# Xue et al. 2014, for values up to 255; Zhang et al. 2017, four scales.
_GMSD_T = 170.0
_MS_GMSD_WEIGHTS = (0.096, 0.596, 0.289, 0.019)
_MS_GMSD_MASKING = 0.5


def image_quality(
    reference: np.ndarray,
    image: np.ndarray,
    *,
    mask: np.ndarray | None = None,
    lpips_weights: Mapping | None = None,
    dists_weights: Mapping | None = None,
) -> dict[str, float]:
    """All measures by name: ``psnr_db``, ``ssim``, ``ms_ssim``, ``gmsd``, ``ms_gmsd``, ``fsim``, ``vsi``.

    GMSD and MS-GMSD are 0 for equal images, the others 1 (PSNR infinite). VSI needs colour and is left out of grey
    images; MS-SSIM needs 176 pixels a side.

    Parameters
    ----------
    mask : (H, W) bool, optional
        Pixels that count. PSNR takes all of them, the others the largest rectangle that they fill: their windows,
        scales and spectra would otherwise take in pixels beyond the mask.
    lpips_weights, dists_weights : optional
        Bring ``lpips`` and ``dists``, 0 for equal images; see `evaluation.images.learned_similarity`.
    """
    measures = {"ssim": ssim, "ms_ssim": ms_ssim, "gmsd": gmsd, "ms_gmsd": ms_gmsd, "fsim": fsim}
    if np.ndim(reference) == 3:
        measures["vsi"] = vsi
    if lpips_weights is not None or dists_weights is not None:
        # Starts torch, which the other measures do without.
        from evaluation.images import learned_similarity as learned

        for name, weights in (("lpips", lpips_weights), ("dists", dists_weights)):
            if weights is not None:
                measures[name] = partial(getattr(learned, name), weights=weights)
    window = (slice(None), slice(None)) if mask is None else largest_rectangle(mask)
    of_all_pixels = {"psnr_db": psnr(reference, image, mask)}
    return of_all_pixels | {name: measure(reference[window], image[window]) for name, measure in measures.items()}


def psnr(reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal to noise ratio [dB] over all channels of the pixels in a mask; infinite where they are equal."""
    a, b = checked_pair(reference, image, smallest=1)
    if mask is not None:
        if mask.shape != a.shape[:2] or not mask.any():
            raise ValueError(f"expected a mask {a.shape[:2]} with pixels, got {mask.shape} with {np.sum(mask)}")
        a, b = a[mask], b[mask]
    error = float(np.mean((a - b) ** 2))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def ssim(reference: np.ndarray, image: np.ndarray) -> float:
    """Structural similarity, the mean over channels and over all windows that lie inside the image.

    Notes
    -----
    Z. Wang, A. Bovik, H. Sheikh, E. Simoncelli, Image quality assessment: from error visibility to structural
    similarity, IEEE Transactions on Image Processing 13 (2004), equation 13, at full resolution.
    """
    a, b = checked_pair(reference, image, smallest=_WINDOW_PX)
    return float(np.mean([_ssim_and_contrast(*pair)[0] for pair in _channels(a, b)]))


def ms_ssim(reference: np.ndarray, image: np.ndarray) -> float:
    """Multi-scale structural similarity over five scales, the mean over channels.

    Notes
    -----
    Z. Wang, E. Simoncelli, A. Bovik, Multi-scale structural similarity for image quality assessment, Asilomar
    Conference (2003), equation 7; between scales squares of 2 by 2 pixels are averaged. Negative terms count as zero.
    """
    levels = len(_MS_SSIM_WEIGHTS)
    a, b = checked_pair(reference, image, smallest=_WINDOW_PX * 2 ** (levels - 1))
    values = []
    for x, y in _channels(a, b):
        value = 1.0
        for level, weight in enumerate(_MS_SSIM_WEIGHTS):
            ssim, contrast = _ssim_and_contrast(x, y)
            value *= max(ssim if level == levels - 1 else contrast, 0.0) ** weight
            x, y = block_means(x, 2), block_means(y, 2)
        values.append(value)
    return float(np.mean(values))


def gmsd(reference: np.ndarray, image: np.ndarray) -> float:
    """Gradient magnitude similarity deviation of the luma at half resolution; 0 for equal images.

    Notes
    -----
    W. Xue, L. Zhang, X. Mou, A. Bovik, Gradient magnitude similarity deviation: a highly efficient perceptual image
    quality index, IEEE Transactions on Image Processing 23 (2014), equations 4 and 6.
    """
    a, b = checked_pair(reference, image, smallest=6)
    x, y = (block_means(yiq(255.0 * v)[0], 2) for v in (a, b))
    return _deviation(x, y)


def ms_gmsd(reference: np.ndarray, image: np.ndarray) -> float:
    """Multi-scale gradient magnitude similarity deviation of the luma, with masking; 0 for equal images.

    Notes
    -----
    B. Zhang, P. Sander, A. Bermak, Gradient magnitude similarity deviation on multiple scales for color image quality
    assessment, ICASSP (2017), without its term for colour.
    """
    a, b = checked_pair(reference, image, smallest=2 ** len(_MS_GMSD_WEIGHTS) + 1)
    x, y = (yiq(255.0 * v)[0] for v in (a, b))
    total = 0.0
    for weight in _MS_GMSD_WEIGHTS:
        total += weight * _deviation(x, y, _MS_GMSD_MASKING) ** 2
        x, y = block_means(x, 2), block_means(y, 2)
    return float(np.sqrt(total))


def _channels(a: np.ndarray, b: np.ndarray):
    stacked = (np.atleast_3d(a), np.atleast_3d(b))
    return [tuple(np.ascontiguousarray(x[..., i]) for x in stacked) for i in range(stacked[0].shape[2])]


def _ssim_and_contrast(x: np.ndarray, y: np.ndarray) -> tuple[float, float]:
    """Means of the similarity, and of its part without luminance, over all windows inside."""
    mean_x, mean_y, xx, yy, xy = (_windowed(v) for v in (x, y, x * x, y * y, x * y))
    var_x, var_y, cov = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    contrast = (2.0 * cov + _C2) / (var_x + var_y + _C2)
    luminance = (2.0 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1)
    return float(np.mean(luminance * contrast)), float(np.mean(contrast))


def _windowed(image: np.ndarray) -> np.ndarray:
    """Means under a Gaussian window, where it lies inside the image."""
    reach = _WINDOW_PX // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SIGMA_PX) ** 2)
    weights /= weights.sum()
    means = ndimage.correlate1d(ndimage.correlate1d(image, weights, axis=0), weights, axis=1)
    return means[reach : image.shape[0] - reach, reach : image.shape[1] - reach]


def _deviation(x: np.ndarray, y: np.ndarray, masking: float = 0.0) -> float:
    """Standard deviation of the similarity of the gradients of two luma images of values up to 255."""
    return float(np.std(similarity(gradient(x, PREWITT), gradient(y, PREWITT), _GMSD_T, masking)))
