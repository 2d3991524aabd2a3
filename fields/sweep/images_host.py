"""Images between the kernels of the sweep where these read the memory of the host: numpy and OpenCV.

Images are arrays (height, width), and flat ones hold their pixels row by row. Callers get these functions from
`fields.sweep.images.images`; `fields.sweep.images_device` is the twin for devices with a memory of their own.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from fields import median as medians
from fields.device import Device
from fields.sweep.kernels.arrays import host
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import DepthMap
from fields.sweep.planes import continued
from fields.sweep.tiles import Tiles, in_tiles

# Heights are averaged over so many pixels before the way is taken in which they rise.
SMOOTH_PX = 5
# Side of the square over which single wrong heights of a coarser pass are taken out [px].
SINGLE_PX = 5
# What lies beside a pixel.
BESIDE = np.ones((3, 3), dtype=np.uint8)


def arrived(device: Device, m: DepthMap) -> DepthMap:
    """A map of the host as the sweep works on it."""
    return m


def left(m: DepthMap) -> DepthMap:
    """A map as the host keeps it."""
    return m


def placed(device: Device, image: np.ndarray) -> np.ndarray:
    """An image of the host, float32 or bool."""
    return image


def fetched(image: np.ndarray) -> np.ndarray:
    """An image, or flat pixels, in the memory of the host."""
    return image


def found_map(view: int, height: np.ndarray, score: np.ndarray) -> DepthMap:
    """What a pass found of a view, which no other has confirmed yet."""
    nobody, spread = np.zeros(height.shape, dtype=np.uint8), np.zeros(height.shape, dtype=np.float16)
    return DepthMap(view, height, brief(score), nobody, spread)


def brief(image: np.ndarray) -> np.ndarray:
    """Scores or spreads as maps keep them."""
    return image.astype(np.float16)


def full(device: Device, shape: tuple[int, int], value: float) -> np.ndarray:
    """An image of one value."""
    return np.full(shape, value, dtype=np.float32)


def flat_copy(image: np.ndarray) -> np.ndarray:
    """The pixels of an image, to be written to."""
    return np.array(image).ravel()


def pixels_of(image: np.ndarray) -> np.ndarray:
    """The pixels of an image, to be written to only where nobody else has it."""
    return image.ravel()


def shaped(flat: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """An image of flat pixels."""
    return flat.reshape(shape)


def where(mask: np.ndarray, there: Any, elsewhere: Any) -> np.ndarray:
    """One of two images, or numbers, by a mask."""
    return np.where(mask, *(np.float32(each) if isinstance(each, float) else each for each in (there, elsewhere)))


def larger(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The larger of two images, pixel by pixel."""
    return np.maximum(one, other)


def lowered(image: np.ndarray, by: float) -> np.ndarray:
    """An image less a number."""
    return image - np.float32(by)


def rising(low: np.ndarray, high: np.ndarray, parallax: float, least: float) -> np.ndarray:
    """Where heights differ by a parallax of more than a least one [px]."""
    return (high - low) * parallax > least


def is_any(mask: np.ndarray) -> bool:
    """Whether a mask holds anywhere."""
    return bool(mask.any())


def extremes(image: np.ndarray) -> tuple[float, float] | None:
    """The least and the largest value of an image; None where all are NaN."""
    return (float(np.nanmin(image)), float(np.nanmax(image))) if np.isfinite(image).any() else None


def median(image: np.ndarray) -> float:
    """Of all pixels of an image."""
    return medians.median(image)


def median_above(image: np.ndarray, least: float) -> float | None:
    """Of the pixels of an image that are above a value; None without any."""
    above = image[image > least]
    return medians.median(above) if len(above) else None


def median_blur(image: np.ndarray, side: int) -> np.ndarray:
    """Medians over squares of 3 or 5 pixels; the rim repeats."""
    return cv2.medianBlur(image, side)


def around(height: np.ndarray, radius: int) -> tuple[np.ndarray, np.ndarray]:
    """Lowest and highest height within a radius [px] of each pixel, without single wrong ones."""
    kernel = np.ones((2 * radius + 1,) * 2, dtype=np.uint8)
    height = cv2.medianBlur(height, 3)
    return cv2.erode(height, kernel), cv2.dilate(height, kernel)


def enlarged(height: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Heights of a coarser pass at another shape, without the single wrong ones."""
    if height.shape == shape:
        return height
    return cv2.medianBlur(cv2.resize(height, shape[::-1], interpolation=cv2.INTER_LINEAR), SINGLE_PX)


def means_of(value: np.ndarray, counts: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Means over the areas of larger pixels of what counts, (height, width) float32; NaN where nothing does."""
    known = counts.astype(np.float32)
    share, total = (cv2.resize(each, shape[::-1], interpolation=cv2.INTER_AREA) for each in (known, known * value))
    return np.where(share > 0.0, total / np.maximum(share, 1e-6), np.float32(np.nan)).astype(np.float32)


def first_shown(device: Device, height: np.ndarray, before: Any | None) -> np.ndarray:
    """Where heights are known that none of so many views before has, a pixel around it added: (height, width) bool.

    Always in the memory of the host: it says which tiles are climbed.
    """
    there = np.isfinite(height)
    if before is not None:
        there &= host(device, before).reshape(there.shape) == 0.0
    return cv2.dilate(there.astype(np.uint8), BESIDE).astype(bool)


def filled(height: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Heights in which unknown ones are replaced by that of the nearest known pixel.

    Otherwise they would stay at the lowest rung in all views alike, and seem to agree.
    """
    if known.all() or not known.any():
        return height
    _, nearest = cv2.distanceTransformWithLabels(
        (~known).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.empty(nearest.max() + 1, dtype=np.float32)
    of_label[nearest[known]] = height[known]
    return of_label[nearest]


def agreement(own: np.ndarray, sums: list[np.ndarray], shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """How many other heights agree, the mean with them [m] and their standard deviation [m], of `compare`'s sums."""
    count, total, square = (each.reshape(shape) for each in sums)
    mean = total / (count + 1.0)
    spread = np.sqrt(np.maximum(square / (count + 1.0) - mean * mean, 0.0))
    return count.astype(np.uint8), own.reshape(shape) + mean, spread


def shown(device: Device, photograph: np.ndarray, score: np.ndarray) -> np.ndarray:
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


def cut(image: np.ndarray, strip: tuple[slice, slice]) -> np.ndarray:
    """A part of an image."""
    return image[strip]


def places_in(device: Device, strip: tuple[slice, slice], width: int) -> np.ndarray:
    """Flat indices of a part of an image of a width."""
    rows, columns = strip
    return (np.arange(rows.start, rows.stop)[:, None] * width + np.arange(columns.start, columns.stop)).ravel()


def places_of(mask: np.ndarray) -> np.ndarray:
    """Flat indices of what a mask has."""
    return np.flatnonzero(mask)


def at(flat: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Some of flat pixels."""
    return flat[pixels]


def put(target: np.ndarray, pixels: np.ndarray, values: np.ndarray, mask: np.ndarray | None = None) -> None:
    """Set some of flat pixels, or those of them that a mask has."""
    if mask is None:
        target[pixels] = values
    else:
        target[pixels[mask]] = values[mask]


def put_strip(
    target: np.ndarray, width: int, result: np.ndarray, rows: slice, columns: slice, strip: slice, radius: int
) -> None:
    """Set rows and columns of flat pixels, of a width, to the results of a strip that spans other columns.

    These begin with the first whole window: ``radius`` pixels into the first row of the target.
    """
    image = np.pad(result, radius).reshape(-1, strip.stop - strip.start)
    inner = image[:, columns.start - strip.start : columns.stop - strip.start]
    target.reshape(-1, width)[rows, columns] = inner


def tile_pixels(device: Device, tiles: Tiles, part: slice) -> np.ndarray:
    """Flat indices of the pixels of tiles with their halo, tile by tile."""
    return tiles.pixels(part).ravel()


def tile_starts(device: Device, tiles: Tiles, part: slice) -> np.ndarray:
    """First rungs [m] of the same pixels."""
    return tiles.starts(part).ravel()


def whole_windows(flat: np.ndarray, lost: int) -> np.ndarray:
    """Of the pixels of tiles, those that results have: without so many at either end."""
    return flat[lost : len(flat) - lost]


def own(device: Device, tiles: Tiles, part: slice, pixels: np.ndarray, lost: int) -> np.ndarray:
    """Which of these are wanted, in their own tile, and have a whole window in it."""
    return whole_windows(tiles.own(part, pixels.reshape(-1, tiles.side, tiles.side)).ravel(), lost)


def extent(wanted: np.ndarray, low: np.ndarray, high: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Least of the low and most of the high values of the wanted pixels of each tile, (rows, columns); inf without."""
    # One axis after the other: both at once do not run in vectors.
    least = in_tiles(np.where(wanted, low, np.inf), size, np.inf).min(axis=1).min(axis=2)
    most = in_tiles(np.where(wanted, high, -np.inf), size, -np.inf).max(axis=1).max(axis=2)
    return least, most


def ways(height: np.ndarray, wanted: np.ndarray, size: int) -> np.ndarray:
    """By how much smoothed heights rise from row to row and from column to column (times 8), (rows, columns, 2) [m].

    The sum over the wanted pixels of each tile.
    """
    smooth = cv2.blur(cv2.medianBlur(height, 3), (SMOOTH_PX, SMOOTH_PX))
    rises = [cv2.Sobel(smooth, cv2.CV_32F, *order) for order in ((0, 1), (1, 0))]
    return np.stack([in_tiles(np.where(wanted, each, 0.0), size, 0.0).sum(axis=(1, 3)) for each in rises], axis=-1)


def on_planes(height: np.ndarray, known: np.ndarray, tolerance: float) -> np.ndarray:
    """`fields.sweep.planes.continued`."""
    return continued(height, known, tolerance)
