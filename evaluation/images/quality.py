"""Image quality measures: PSNR, SSIM, MS-SSIM, GMSD, MS-GMSD; no network and no weights.

FSIM and VSI are in `evaluation.images.feature_similarity`, LPIPS and DISTS in `evaluation.images.learned_similarity`.
Images are (H, W) or (H, W, 3), 0 to 1.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

import numpy as np
from scipy import ndimage

from evaluation.images.feature_similarity import fsim, vsi
from evaluation.images.inputs import PREWITT, checked_pair, gradient, largest_rectangle, pooled, similarity, yiq

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

    Raises
    ------
    ValueError
        As `evaluation.images.inputs.checked_pair`, for the rectangle too, and where weights are missing.
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
    whole = {"psnr_db": psnr(reference, image, mask)}
    return whole | {name: measure(reference[window], image[window]) for name, measure in measures.items()}


def psnr(reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal to noise ratio [dB] over all channels of the pixels in a mask; infinite where they are equal.

    Raises
    ------
    ValueError
        As `evaluation.images.inputs.checked_pair`, and if the mask is of another shape or empty.
    """
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
    x, y = (pooled(yiq(255.0 * v)[0], 2) for v in (a, b))
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
