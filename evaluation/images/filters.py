"""Filters of the measures of image quality: luma, means over squares, gradients, the similarity of two maps."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

# Luma and the two colour differences of YIQ (NTSC 1953), rows Y, I, Q.
_YIQ = np.array([[0.299, 0.587, 0.114], [0.5959, -0.2746, -0.3213], [0.2115, -0.5227, 0.3112]])
SCHARR = np.array([[3.0, 0.0, -3.0], [10.0, 0.0, -10.0], [3.0, 0.0, -3.0]]) / 16.0
PREWITT = np.array([[1.0, 0.0, -1.0], [1.0, 0.0, -1.0], [1.0, 0.0, -1.0]]) / 3.0


def yiq(image: np.ndarray) -> np.ndarray:
    """Luma and, of a colour image, the colour differences I and Q: (1, H, W) or (3, H, W)."""
    return image[None] if image.ndim == 2 else np.einsum("cd,hwd->chw", _YIQ, image)


def pooled(image: np.ndarray, size: int) -> np.ndarray:
    """Means (..., H // size, W // size) of squares of (..., H, W); rows and columns that are left over are dropped."""
    *others, height, width = image.shape
    rows, columns = height // size, width // size
    cut = image[..., : rows * size, : columns * size]
    return cut.reshape(*others, rows, size, columns, size).mean(axis=(-3, -1))


def gradient(image: np.ndarray, kernel: np.ndarray) -> np.ndarray:
    """Magnitude (H, W) of the gradient by a kernel (3, 3) and its transpose, zero beyond the image."""
    across, down = (ndimage.correlate(image, k, mode="constant") for k in (kernel, kernel.T))
    return np.hypot(across, down)


def similarity(a: np.ndarray, b: np.ndarray, constant: float, masking: float = 0.0) -> np.ndarray:
    """``((2 - m) a b + c) / (a^2 + b^2 - m a b + c)``: 1 where two maps agree; m, from 0 to 1, weakens weak edges."""
    return ((2.0 - masking) * a * b + constant) / (a**2 + b**2 - masking * a * b + constant)
