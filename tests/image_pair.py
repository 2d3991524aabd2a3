"""Two colour images to measure image quality with: waves and edges, and the same blurred, noisy and faded."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

SHAPES = {"even": (256, 320), "large": (512, 640)}


def image_pair(name: str = "even") -> tuple[np.ndarray, np.ndarray]:
    """An image (H, W, 3), 0 to 1, and what has become of it; the same at every call and on every machine."""
    height, width = SHAPES[name]
    y, x = np.mgrid[0:height, 0:width].astype(np.float64)
    waves = [np.sin(x / p + y / q) for p, q in ((7.0, 23.0), (31.0, -11.0), (3.0, 5.0))]
    disc = (np.hypot(x - 0.4 * width, y - 0.55 * height) < 0.2 * height).astype(np.float64)
    bars = ((x // 24) % 2) * (y > 0.7 * height)
    layers = [0.5 + 0.16 * waves[i] + 0.14 * waves[(i + 1) % 3] * disc + 0.12 * (i - 1) * disc for i in range(3)]
    image = np.clip(np.stack(layers, axis=-1) + 0.15 * bars[..., None], 0.0, 1.0)
    # Noise from whole numbers, equal to the last bit everywhere.
    noise = ((x * 73 + y * 179 + x * y * 31) % 256 / 255.0 - 0.5)[..., None] * np.array([0.10, 0.08, 0.12])
    blurred = ndimage.gaussian_filter(image, (1.2, 1.2, 0.0))
    return image, np.clip(0.9 * blurred + 0.03 + noise, 0.0, 1.0)
