"""Local shifts of photographs against each other, by waves and errors of the poses.

A height fitted to all photographs absorbs a part of such a shift and is moved by it. What remains, a shift of the
residuals of a photograph along the gradient of the albedo, common to many pixels, gives the variance of the shifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from fields.solver.gauss_newton import TileSolution, gradients_of
from fields.solver.tile import Tile

# Shifts are constant within a Gauss window of this standard deviation: shorter than waves, wide against noise.
WINDOW_PX = 4.0
# Larger ones are no shifts; and least determinant over squared trace of the structure tensor.
_LARGEST_PX, _LEAST_ACROSS = 2.0, 1e-3
# Share of the Gauss window that a photograph has to see; and photographs that determine more than a height.
_SEEN, _LEAST_VIEWS = 0.5, 3
# Fewest pixels of a tile.
_LEAST_PIXELS = 200


@dataclass(frozen=True)
class Shifts:
    """Standard deviation of the shifts of photographs along each axis of the image."""

    anywhere_px: float  # That of poses
    by_depth_px_m: float  # [px/m]: that of waves, which grows with the depth of the water

    def variance(self, depth: np.ndarray) -> np.ndarray:
        """Variance (N,) [px^2] of the shifts at depths (N,) [m], 0 on dry ground."""
        return self.anywhere_px**2 + (self.by_depth_px_m * depth) ** 2


def depth_of(height: np.ndarray, is_wet: bool) -> np.ndarray:
    """Depth (N,) [m] of heights (N,) over the water plane; 0 in a survey that has no water."""
    return np.maximum(-height, 0.0) if is_wet else np.zeros_like(height)


def shifts_of(samples: list[tuple[Tile, TileSolution]], noise_share: float, is_wet: bool) -> Shifts:
    """Shifts of a survey, from solved tiles; zero where too few pixels are seen by three photographs.

    ``noise_share`` is that of heights in `fields.solver.correlation.NoiseShares`: noise seems to be a shift too, and is
    taken off.
    """
    found = [_in_tile(tile, solved, noise_share) for tile, solved in samples]
    known = [
        (np.mean(square), np.mean(depth_of(solved.height[use], is_wet) ** 2))
        for (square, use), (_, solved) in zip(found, samples, strict=True)
        if use.sum() >= _LEAST_PIXELS
    ]
    if not known:
        return Shifts(0.0, 0.0)
    # Loading it takes a fifth of a second, which runs without a solver need not spend.
    from scipy.optimize import nnls

    squares, depths = np.array(known).T
    (anywhere, by_depth), _ = nnls(np.stack([np.ones_like(depths), depths], axis=-1), squares)
    return Shifts(float(np.sqrt(anywhere)), float(np.sqrt(by_depth)))


def _in_tile(tile: Tile, solved: TileSolution, noise_share: float) -> tuple[np.ndarray, np.ndarray]:
    """Variance [px^2] of the shifts along an axis, and the pixels (N,) bool that determine it."""
    brightness = solved.brightness
    across, down = gradients_of(tile, brightness.albedo)
    area = 4.0 * np.pi * WINDOW_PX**2
    square, of_noise, count = np.zeros((3, len(tile)))
    for weight, residual in zip(brightness.weight, brightness.residual, strict=True):
        xx, xy, yy, x, y, seen = (
            _local_mean(tile, part)
            for part in (
                weight * across * across, weight * across * down, weight * down * down,
                weight * across * residual, weight * down * residual, (weight > 0.0).astype(np.float32),
            )
        )  # fmt: skip
        size, both = xx * yy - xy * xy, xx + yy
        use = (size > _LEAST_ACROSS * both * both) & (seen > _SEEN)
        size = np.where(use, size, 1.0)
        shift = np.hypot(yy * x - xy * y, xx * y - xy * x) / size
        use &= shift < _LARGEST_PX
        square += np.where(use, shift * shift, 0.0)
        of_noise += np.where(use, noise_share * both / size / area, 0.0)
        count += use
    use = count >= _LEAST_VIEWS
    # Of two degrees of freedom per photograph the albedo absorbs two and the height one.
    return (square / np.maximum(2.0 * count - 3.0, 1.0) - of_noise / (2.0 * np.maximum(count, 1.0)))[use], use


def _local_mean(tile: Tile, values: np.ndarray) -> np.ndarray:
    """Local mean of values (N,) by a Gauss filter; 0 where there are none."""
    image = np.zeros(tile.inside.shape, dtype=np.float32)
    image[tile.inside] = values
    return ndimage.gaussian_filter(image, WINDOW_PX, truncate=2.5)[tile.inside]
