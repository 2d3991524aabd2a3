"""Quality of images (H, W) or (H, W, 3), 0 to 1: PSNR, and SSIM over the largest rectangle of a mask.

SSIM is written out after its paper: that of torchmetrics 1.9 averages windows that reach beyond the image, too (0.002
apart on the test image), and takes about forty times as long on a CPU.
"""

import numpy as np
from scipy import ndimage

# Wang et al. 2004: Gaussian window and the constants that keep quotients finite.
_WINDOW_PX, _SIGMA_PX = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def image_quality(reference: np.ndarray, image: np.ndarray, *, mask: np.ndarray | None = None) -> dict[str, float]:
    """``psnr_db`` over the pixels in a mask (H, W) bool, and ``ssim`` over the largest rectangle that they fill.

    The windows of SSIM would otherwise take in pixels beyond the mask; without it where the rectangle holds no window.
    """
    found = {"psnr_db": psnr(reference, image, mask)}
    window = (slice(None), slice(None)) if mask is None else largest_rectangle(mask)
    if min(reference[window].shape[:2]) >= _WINDOW_PX:
        found["ssim"] = ssim(reference[window], image[window])
    return found


def psnr(reference: np.ndarray, image: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal to noise ratio [dB] over all channels of the pixels in a mask; infinite where they are equal."""
    a, b = _checked_pair(reference, image, smallest=1)
    if mask is not None:
        if mask.shape != a.shape[:2] or not mask.any():
            raise ValueError(f"expected a mask {a.shape[:2]} with pixels, got {mask.shape} with {np.sum(mask)}")
        a, b = a[mask], b[mask]
    error = float(np.mean((a - b) ** 2))
    return float("inf") if error == 0.0 else -10.0 * float(np.log10(error))


def ssim(reference: np.ndarray, image: np.ndarray) -> float:
    """Structural similarity, the mean over channels and over all windows that lie inside the image.

    Z. Wang, A. Bovik, H. Sheikh, E. Simoncelli, Image quality assessment: from error visibility to structural
    similarity, IEEE Transactions on Image Processing 13 (2004), equation 13, at full resolution.
    """
    x, y = (np.atleast_3d(v) for v in _checked_pair(reference, image, smallest=_WINDOW_PX))
    mean_x, mean_y, xx, yy, xy = (_windowed(v) for v in (x, y, x * x, y * y, x * y))
    var_x, var_y, cov = xx - mean_x**2, yy - mean_y**2, xy - mean_x * mean_y
    contrast = (2.0 * cov + _C2) / (var_x + var_y + _C2)
    return float(np.mean((2.0 * mean_x * mean_y + _C1) / (mean_x**2 + mean_y**2 + _C1) * contrast))


def _windowed(image: np.ndarray) -> np.ndarray:
    """Means under a Gaussian window, where it lies inside the image."""
    reach = _WINDOW_PX // 2
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SIGMA_PX) ** 2)
    weights /= weights.sum()
    means = ndimage.correlate1d(ndimage.correlate1d(image, weights, axis=0), weights, axis=1)
    return means[reach : image.shape[0] - reach, reach : image.shape[1] - reach]


def _checked_pair(reference, image, *, smallest: int) -> tuple[np.ndarray, np.ndarray]:
    """Both images as float64."""
    pair = np.asarray(reference, dtype=np.float64), np.asarray(image, dtype=np.float64)
    shape = pair[0].shape
    if pair[1].shape != shape or len(shape) not in (2, 3) or (len(shape) == 3 and shape[2] != 3):
        raise ValueError(f"expected two images of one shape (H, W) or (H, W, 3), got {shape} and {pair[1].shape}")
    if min(shape[:2]) < smallest:
        raise ValueError(f"expected images of at least {smallest} x {smallest} pixels, got {shape[1]} x {shape[0]}")
    for values in pair:
        if not np.isfinite(values).all():
            raise ValueError(f"expected finite values, got {np.sum(~np.isfinite(values))} that are NaN or infinite")
        if values.min() < 0.0 or values.max() > 1.0:
            raise ValueError(f"expected values from 0 to 1, got {values.min():g} to {values.max():g}; divide by 255?")
    return pair


def largest_rectangle(mask: np.ndarray) -> tuple[slice, slice]:
    """Rows and columns of the largest rectangle of a mask (H, W) bool whose pixels are all true, the first of equals.

    >>> largest_rectangle(np.array([[True, False, True], [True, True, True], [True, True, False]]))
    (slice(1, 3, None), slice(0, 2, None))
    """
    # Row by row, the columns of true pixels that end there are the bars of a histogram; each bar is extended to both
    # sides until a shorter one.
    best, found = 0, (slice(0, 0), slice(0, 0))
    bars = np.zeros(mask.shape[1] + 1, dtype=np.int64)
    for row, line in enumerate(mask):
        bars[:-1] = np.where(line, bars[:-1] + 1, 0)
        # Open bars, each higher than the one before: first column and height. A last bar of height zero closes all.
        rising: list[tuple[int, int]] = []
        for column, height in enumerate(bars.tolist()):
            first = column
            while rising and rising[-1][1] >= height:
                first, tall = rising.pop()
                if tall * (column - first) > best:
                    best = tall * (column - first)
                    found = (slice(row + 1 - tall, row + 1), slice(first, column))
            rising.append((first, height))
    return found
