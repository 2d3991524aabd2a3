"""How alike two images are: PSNR, SSIM, MS-SSIM, GMSD, MS-GMSD; no network and no weights.

The other two of the set, FSIM and VSI, are in `evaluation.feature_similarity`. Images are (H, W) or (H, W, 3), 0 to 1.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from evaluation.feature_similarity import fsim, vsi
from evaluation.images import PREWITT, checked_pair, gradient, pooled, similarity, yiq

# Wang et al. 2004: Gaussian window and the constants that keep quotients finite.
_WINDOW_PX, _SIGMA_PX = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2
# Wang et al. 2003, five scales.
_MS_SSIM_WEIGHTS = (0.0448, 0.2856, 0.3001, 0.2363, 0.1333)
# Xue et al. 2014, for values up to 255; Zhang et al. 2017, four scales.
_GMSD_T = 170.0
_MS_GMSD_WEIGHTS = (0.096, 0.596, 0.289, 0.019)
_MS_GMSD_MASKING = 0.5


def image_quality(reference: np.ndarray, image: np.ndarray) -> dict[str, float]:
    """All measures by name: ``psnr_db``, ``ssim``, ``ms_ssim``, ``gmsd``, ``ms_gmsd``, ``fsim``, ``vsi``.

    GMSD and MS-GMSD are 0 for equal images, the others 1 (PSNR infinite). VSI needs colour and is left out of grey
    images; MS-SSIM needs 161 pixels a side.

    Raises
    ------
    ValueError
        As `evaluation.images.checked_pair`.
    """
    measures = {"psnr_db": psnr, "ssim": ssim, "ms_ssim": ms_ssim, "gmsd": gmsd, "ms_gmsd": ms_gmsd, "fsim": fsim}
    if np.ndim(reference) == 3:
        measures["vsi"] = vsi
    return {name: measure(reference, image) for name, measure in measures.items()}


def psnr(reference: np.ndarray, image: np.ndarray) -> float:
    """Peak signal to noise ratio [dB] over all pixels and channels; infinite for equal images."""
    a, b = checked_pair(reference, image, smallest=1)
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
    a, b = checked_pair(reference, image, smallest=(_WINDOW_PX - 1) * 2 ** (levels - 1) + 1)
    values = []
    for x, y in _channels(a, b):
        value = 1.0
        for level, weight in enumerate(_MS_SSIM_WEIGHTS):
            whole, contrast = _ssim_and_contrast(x, y)
            value *= max(whole if level == levels - 1 else contrast, 0.0) ** weight
            x, y = pooled(x, 2), pooled(y, 2)
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
    return _deviation(*(pooled(yiq(255.0 * x)[0], 2) for x in (a, b)))


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
        x, y = pooled(x, 2), pooled(y, 2)
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
