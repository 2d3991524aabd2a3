"""Images (height, width) between the kernels of the sweep: filters, tiles and strips of heights and scores.

They lie in the memory of the host, whatever the device of the kernels.
"""

from __future__ import annotations

import cv2
import numpy as np

from fields.sweep.tiles import in_tiles

_SMOOTH_PX = 5  # Side of the box filter of heights before their gradient is taken [px]
_SINGLE_PX = 5  # Side of the median filter of the heights of a coarser pass [px]
_NEIGHBOURHOOD = np.ones((3, 3), dtype=np.uint8)  # A pixel and its eight neighbours


def median_above(image: np.ndarray, least: float) -> float | None:
    """Median of the pixels above a value; None without any."""
    above = image[image > least]
    return median(above) if len(above) else None


def local_min_max(height: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Minimum and maximum height within a radius [px] of each pixel, after a median filter."""
    kernel = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    height = cv2.medianBlur(height, 3)
    return cv2.erode(height, kernel), cv2.dilate(height, kernel)


def upsample(height: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a coarser pass at another shape, bilinear, after a median filter."""
    if height.shape == shape:
        return height
    return cv2.medianBlur(cv2.resize(height, shape[::-1], interpolation=cv2.INTER_LINEAR), _SINGLE_PX)


def masked_means(value: np.ndarray, mask: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Means of the masked values over the areas of larger pixels, (height, width) float32; NaN where none is."""
    known = mask.astype(np.float32)
    share, total = (cv2.resize(each, shape[::-1], interpolation=cv2.INTER_AREA) for each in (known, known * value))
    return np.where(share > 0.0, total / np.maximum(share, 1e-6), np.float32(np.nan)).astype(np.float32)


def newly_visible(height: np.ndarray, num_agreeing: np.ndarray | None) -> np.ndarray:
    """Pixels with a height that no steeper view has, dilated by a pixel: (height, width) bool.

    ``num_agreeing`` (height * width) is the number of steeper views that agree with it; None where there are none.
    """
    is_selected = np.isfinite(height)
    if num_agreeing is not None:
        is_selected &= num_agreeing.reshape(is_selected.shape) == 0.0
    return cv2.dilate(is_selected.astype(np.uint8), _NEIGHBOURHOOD).astype(bool)


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


def strip_indices(strip: tuple[slice, slice], width: int) -> np.ndarray:
    """Flat indices of a part of an image of a width."""
    rows, columns = strip
    return (np.arange(rows.start, rows.stop)[:, None] * width + np.arange(columns.start, columns.stop)).ravel()


def put_strip(
    target: np.ndarray, width: int, result: np.ndarray, part: tuple[slice, slice], strip: slice, radius: int
) -> None:
    """Copy the wanted rows and columns of a strip's results into a flat image of ``width`` columns.

    ``part`` (rows, columns): the wanted ones, in the image. ``strip``: columns of the image that the strip spans.
    ``radius`` [px]: of the windows: results begin with the first whole one, so many pixels into the first of the wanted
    rows.
    """
    image = np.pad(result, radius).reshape(-1, strip.stop - strip.start)
    columns = part[1]
    target.reshape(-1, width)[part] = image[:, columns.start - strip.start : columns.stop - strip.start]


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
    smooth = cv2.blur(cv2.medianBlur(height, 3), (_SMOOTH_PX, _SMOOTH_PX))
    rises = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((0, 1), (1, 0))]
    return np.stack([in_tiles(np.where(wanted, each, 0.0), size, 0.0).sum(axis=(1, 3)) for each in rises], axis=-1)


def median(values: np.ndarray) -> float:
    """Median of an array of any shape as numpy's: NaN where any value is NaN. (384, 512): 0.14 instead of 2.3 ms."""
    return float(median_reordering(values.flatten()))


def median_reordering(values: np.ndarray) -> np.floating:
    """The median of values (N,), which are reordered."""
    if not len(values):
        raise ValueError("the median of no values is asked for; expected one or more")
    half = len(values) // 2
    values.partition(half)
    most = values[half:].max()
    if np.isnan(most):
        return most
    return values[half] if len(values) % 2 else (values[:half].max() + values[half]) / values.dtype.type(2.0)
