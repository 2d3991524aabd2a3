"""Inputs and filters of image measures: checks of two images (H, W) or (H, W, 3), 0 to 1, and masks as rectangles."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

# Luma and the two colour differences of YIQ (NTSC 1953), rows Y, I, Q.
_YIQ = np.array([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])
SCHARR = np.array([[3.0, 0.0, -3.0], [10.0, 0.0, -10.0], [3.0, 0.0, -3.0]]) / 16.0
PREWITT = np.array([[1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, -1.0]]) / 3.0


def checked_pair(reference, image, *, smallest: int) -> tuple[np.ndarray, np.ndarray]:
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

    Notes
    -----
    Row by row, the columns of true pixels that end there are the bars of a histogram; each bar is extended to both
    sides until a shorter one.

    Examples
    --------
    >>> largest_rectangle(np.array([[True, False, True], [True, True, True], [True, True, False]]))
    (slice(1, 3, None), slice(0, 2, None))
    """
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


def yiq(image: np.ndarray) -> np.ndarray:
    """Luma and, of a colour image, the colour differences I and Q: (1, H, W) or (3, H, W)."""
    return image[None] if image.ndim == 2 else np.einsum("cd,hwd->chw", _YIQ, image)


def block_means(image: np.ndarray, size: int) -> np.ndarray:
    """Block means (..., H // size, W // size) of (..., H, W); left-over rows and columns are dropped."""
    *others, height, width = image.shape
    rows, columns = height // size, width // size
    cut = image[..., : rows * size, : columns * size]
    return cut.reshape(*others, rows, size, columns, size).mean(axis=(-3, -1))


def gradient(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Magnitude (H, W) of the gradient by a kernel (3, 3) and its transpose, zero beyond the image."""
    across, down = (ndimage.correlate(image, k, mode="constant") for k in (kernel, kernel.T))
    return np.hypot(across, down)


def similarity(a: np.ndarray, b: np.ndarray, constant: float, masking: float = 0.0) -> np.ndarray:
    """Similarity map ``((2 - m) a b + c) / (a^2 + b^2 - m a b + c)``, 1 where a and b agree; m masks weak edges."""
    return ((2.0 - masking) * a * b + constant) / (a**2 + b**2 - masking * a * b + constant)
