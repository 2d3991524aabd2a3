"""Images between the kernels in the memory of the host: numpy and OpenCV.

Images are arrays (height, width), and flat ones hold their pixels row by row. Callers get these functions from
`fields.sweep.images.image_backend`; `fields.sweep.images_device` does the same on devices with a memory of their own.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from fields import median as medians
from fields.device import Device
from fields.sweep import planes
from fields.sweep.kernels.arrays import host
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap
from fields.sweep.tiles import ImageTiles, in_tiles

# Side of the box filter of heights before their gradient is taken [px].
SMOOTH_PX = 5
# Side of the median filter of the heights of a coarser pass [px].
SINGLE_PX = 5
# A pixel and its eight neighbours.
NEIGHBOURHOOD = np.ones((3, 3), dtype=np.uint8)


def upload(device: Device, m: HeightMap) -> HeightMap:
    """Map of the host as the kernels take it."""
    return m


def download(m: HeightMap) -> HeightMap:
    """Map in the types of the host."""
    return m


def to_device(device: Device, image: np.ndarray) -> np.ndarray:
    """Image of the host, float32 or bool, as the kernels take it."""
    return image


def to_host(image: np.ndarray) -> np.ndarray:
    """Image, or flat pixels, in the memory of the host."""
    return image


def new_map(view: int, height: np.ndarray, score: np.ndarray) -> HeightMap:
    """Map of what a pass found of a view, not confirmed yet."""
    nobody, spread = np.zeros(height.shape, dtype=np.uint8), np.zeros(height.shape, dtype=np.float16)
    return HeightMap(view, height, to_half(score), nobody, spread)


def to_half(image: np.ndarray) -> np.ndarray:
    """Scores or spreads in the type of maps."""
    return image.astype(np.float16)


def full(device: Device, shape: tuple[int, int], value: float) -> np.ndarray:
    """Image of a constant."""
    return np.full(shape, value, dtype=np.float32)


def flat_copy(image: np.ndarray) -> np.ndarray:
    """Copy of the pixels of an image, flat."""
    return np.array(image).ravel()


def flat_view(image: np.ndarray) -> np.ndarray:
    """Pixels of an image, flat, not copied where that can be avoided."""
    return image.ravel()


def reshaped(flat: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Flat pixels as an image."""
    return flat.reshape(shape)


def where(mask: np.ndarray, inside: Any, outside: Any) -> np.ndarray:
    """Selection of one of two images, or numbers, by a mask."""
    return np.where(mask, *(np.float32(each) if isinstance(each, float) else each for each in (inside, outside)))


def pixelwise_max(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pixelwise maximum."""
    return np.maximum(one, other)


def subtract(image: np.ndarray, by: float) -> np.ndarray:
    """Image minus a number."""
    return image - np.float32(by)


def exceeds_shift(low: np.ndarray, high: np.ndarray, parallax_px_m: float, least_px: float) -> np.ndarray:
    """Pixels whose heights differ by so much that it shifts the image by more than ``least_px``."""
    return (high - low) * parallax_px_m > least_px


def any_true(mask: np.ndarray) -> bool:
    """Whether any pixel of a mask is True."""
    return bool(mask.any())


def min_max(image: np.ndarray) -> tuple[float, float] | None:
    """Minimum and maximum of an image; None where all are NaN."""
    return (float(np.nanmin(image)), float(np.nanmax(image))) if np.isfinite(image).any() else None


def median(image: np.ndarray) -> float:
    """Median of all pixels."""
    return medians.median(image)


def median_above(image: np.ndarray, least: float) -> float | None:
    """Median of the pixels above a value; None without any."""
    above = image[image > least]
    return medians.median(above) if len(above) else None


def median_blur(image: np.ndarray, side: int) -> np.ndarray:
    """Median filter of 3 or 5 pixels a side; replicated border."""
    return cv2.medianBlur(image, side)


def local_min_max(height: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum height within a radius [px] of each pixel, after a median filter."""
    kernel = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    height = cv2.medianBlur(height, 3)
    return cv2.erode(height, kernel), cv2.dilate(height, kernel)


def upsample(height: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a coarser pass at another shape, bilinear, after a median filter."""
    if height.shape == shape:
        return height
    return cv2.medianBlur(cv2.resize(height, shape[::-1], interpolation=cv2.INTER_LINEAR), SINGLE_PX)


def masked_means(value: np.ndarray, counts: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Means of the masked values over the areas of larger pixels, (height, width) float32; NaN where none is."""
    known = counts.astype(np.float32)
    share, total = (cv2.resize(each, shape[::-1], interpolation=cv2.INTER_AREA) for each in (known, known * value))
    return np.where(share > 0.0, total / np.maximum(share, 1e-6), np.float32(np.nan)).astype(np.float32)


def newly_visible(device: Device, height: np.ndarray, num_agreeing: Any | None) -> np.ndarray:
    """Pixels with a height that no steeper view has, dilated by a pixel: (height, width) bool.

    ``num_agreeing`` (height * width) is the number of steeper views that agree with it; None where there are none. The
    mask is always in the memory of the host: it says which tiles are matched.
    """
    is_selected = np.isfinite(height)
    if num_agreeing is not None:
        is_selected &= host(device, num_agreeing).reshape(is_selected.shape) == 0.0
    return cv2.dilate(is_selected.astype(np.uint8), NEIGHBOURHOOD).astype(bool)


def fill_nearest(height: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Heights with unknown ones replaced by that of the nearest known pixel.

    Otherwise they would stay at the lowest hypothesis in all views alike, and seem to agree.
    """
    if known.all() or not known.any():
        return height
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.empty(nearest.max() + 1, dtype=np.float32)
    of_label[nearest[known]] = height[known]
    return of_label[nearest]


def agreement_statistics(own: np.ndarray, sums: list[np.ndarray], shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Number of peers that agree, mean height [m] and standard deviation [m] from the sums of `compare_heights`."""
    count, total, square = (each.reshape(shape) for each in sums)
    mean = total / (count + 1.0)
    spread = np.sqrt(np.maximum(square / (count + 1.0) - mean * mean, 0.0))
    return count.astype(np.uint8), own.reshape(shape) + mean, spread


def mask_scores(device: Device, photograph: np.ndarray, score: np.ndarray) -> np.ndarray:
    """Scores, -1 at pixels left out of a photograph of the host."""
    return np.where(np.isnan(photograph), score.dtype.type(-1.0), score)


def grey(stack: ViewStack, view: int, strip: tuple[slice, slice]) -> np.ndarray:
    """Grey levels of a part of a photograph."""
    return stack.images[view][strip]


def grey_at(stack: ViewStack, view: int, pixels: np.ndarray) -> np.ndarray:
    """Grey levels of some pixels of a photograph, flat."""
    return stack.images[view].ravel()[pixels]


def heights_at(stack: ViewStack, view: int, pixels: np.ndarray | None) -> np.ndarray:
    """Heights of a stack of height maps: of all pixels of a view, or of some."""
    return stack.images[view].ravel() if pixels is None else grey_at(stack, view, pixels)


def crop(image: np.ndarray, strip: tuple[slice, slice]) -> np.ndarray:
    """A part of an image."""
    return image[strip]


def strip_indices(device: Device, strip: tuple[slice, slice], width: int) -> np.ndarray:
    """Flat indices of a part of an image of a width."""
    rows, columns = strip
    return (np.arange(rows.start, rows.stop)[:, None] * width + np.arange(columns.start, columns.stop)).ravel()


def indices_of(mask: np.ndarray) -> np.ndarray:
    """Flat indices of the True pixels of a mask."""
    return np.flatnonzero(mask)


def values_at(flat: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Flat pixels at indices."""
    return flat[pixels]


def put(target: np.ndarray, pixels: np.ndarray, values: np.ndarray, mask: np.ndarray | None = None) -> None:
    """Set flat pixels at indices, where an optional mask is True."""
    if mask is None:
        target[pixels] = values
    else:
        target[pixels[mask]] = values[mask]


def put_strip(
    target: np.ndarray, width: int, result: np.ndarray, part: tuple[slice, slice], strip: slice, radius: int
) -> None:
    """Copy the wanted rows and columns of a strip's results into a flat image of ``width`` columns.

    Parameters
    ----------
    part : (rows, columns)
        The wanted ones, in the image.
    strip : slice
        Columns of the image that the strip spans.
    radius : [px]
        Of the windows: results begin with the first whole one, so many pixels into the first of the wanted rows.
    """
    image = np.pad(result, radius).reshape(-1, strip.stop - strip.start)
    columns = part[1]
    target.reshape(-1, width)[part] = image[:, columns.start - strip.start : columns.stop - strip.start]


def tile_indices(device: Device, tiles: ImageTiles, part: slice) -> np.ndarray:
    """Flat indices of the pixels of tiles with their halo, tile by tile."""
    return tiles.pixels(part).ravel()


def tile_starts(device: Device, tiles: ImageTiles, part: slice) -> np.ndarray:
    """Lowest hypotheses [m] of the same pixels."""
    return tiles.starts(part).ravel()


def trim_halo(flat: np.ndarray, lost: int) -> np.ndarray:
    """Drop ``lost`` values at each end, as the kernels do."""
    return flat[lost : len(flat) - lost]


def own_pixels(device: Device, tiles: ImageTiles, part: slice, pixels: np.ndarray, lost: int) -> np.ndarray:
    """Mask of the pixels that are wanted, in their own tile, and have a whole window in it."""
    return trim_halo(tiles.own(part, pixels.reshape(-1, tiles.side, tiles.side)).ravel(), lost)


def tile_extents(wanted: np.ndarray, low: np.ndarray, high: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Least low and largest high value of the wanted pixels of each tile, (rows, columns); inf if none."""
    # One axis after the other: numpy vectorises no reduction over both.
    least = in_tiles(np.where(wanted, low, np.inf), size, np.inf).min(axis=1).min(axis=2)
    most = in_tiles(np.where(wanted, high, -np.inf), size, -np.inf).max(axis=1).max(axis=2)
    return least, most


def tile_gradients(height: np.ndarray, wanted: np.ndarray, size: int) -> np.ndarray:
    """Gradient of smoothed heights along rows and columns by Sobel's kernel (8 times the rise), (rows, columns, 2) [m].

    The sum over the wanted pixels of each tile.
    """
    smooth = cv2.blur(cv2.medianBlur(height, 3), (SMOOTH_PX, SMOOTH_PX))
    rises = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((0, 1), (1, 0))]
    return np.stack([in_tiles(np.where(wanted, each, 0.0), size, 0.0).sum(axis=(1, 3)) for each in rises], axis=-1)


def extrapolate_planes(height: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """`fields.sweep.planes.extrapolate_planes`."""
    return planes.extrapolate_planes(height, known, tolerance)
