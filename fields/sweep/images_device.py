"""Images between the kernels on a device with memory of its own, where they stay between the passes.

The counterpart of `fields.sweep.images_host`, written once for Dr.Jit and torch: images are their tensors (height,
width). Only scalars (a median, whether a mask is True anywhere), which tiles are matched and which parts of a view
become points go to the host.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from fields.device import Device
from fields.sweep import device_filters, images_host
from fields.sweep.device_filters import Place
from fields.sweep.kernels.arrays import (
    arange,
    as_numpy,
    constant_array,
    copy_of,
    count_true,
    evaluate,
    flatten,
    floats,
    gather,
    kth_smallest,
    nonzero,
    scalar,
    scatter,
    size_of,
    to_float,
    unflatten,
    vector,
)
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import HeightMap
from fields.sweep.tiles import ImageTiles
from refract import kernels

# The rest of the functions of `fields.sweep.images_host`.
local_min_max, upsample, tile_extents = (
    device_filters.local_min_max,
    device_filters.upsample,
    device_filters.tile_extents,
)
fill_nearest, masked_means, median_blur = (
    device_filters.fill_nearest,
    device_filters.masked_means,
    device_filters.median_blur,
)
extrapolate_planes, tile_gradients = device_filters.extrapolate_planes, device_filters.tile_gradients


def upload(device: Device, m: HeightMap) -> HeightMap:
    """Map of the host as the kernels take it: all of it float32."""
    arrays = (m.height, m.score, m.agreeing, m.spread)
    return HeightMap(m.view, *(unflatten(floats(device, each), each.shape) for each in arrays))


def download(m: HeightMap) -> HeightMap:
    """Map in the types of the host."""
    kinds = (np.float32, np.float16, np.uint8, np.float16)
    arrays = (m.height, m.score, m.agreeing, m.spread)
    return HeightMap(m.view, *(as_numpy(each).astype(kind) for each, kind in zip(arrays, kinds, strict=True)))


def to_device(device: Device, image: np.ndarray) -> Any:
    """Image of the host, float32 or bool, as the kernels take it."""
    flat = floats(device, image)
    return unflatten(flat > 0.0 if image.dtype == bool else flat, image.shape)


def to_host(image: Any) -> np.ndarray:
    """Image, or flat pixels, in the memory of the host."""
    return as_numpy(image)


def new_map(view: int, height: Any, score: Any) -> HeightMap:
    """Map of what a pass found of a view, not confirmed yet."""
    flat = flatten(height)
    nobody, spread = (unflatten(constant_array(flat, 0.0, size_of(flat)), height.shape) for _ in range(2))
    return HeightMap(view, height, score, nobody, spread)


def to_half(image: Any) -> Any:
    """Scores or spreads in the type of maps."""
    return image


def full(device: Device, shape: tuple[int, int], value: float) -> Any:
    """Image of a constant."""
    return unflatten(constant_array(floats(device, np.zeros(1)), value, math.prod(shape)), shape)


def flat_copy(image: Any) -> Any:
    """Copy of the pixels of an image, flat."""
    return copy_of(flatten(image))


def flat_view(image: Any) -> Any:
    """Pixels of an image, flat, not copied where that can be avoided."""
    return flatten(image)


def reshaped(flat: Any, shape: tuple[int, int]) -> Any:
    """Flat pixels as an image."""
    return unflatten(flat, shape)


def where(mask: Any, inside: Any, outside: Any) -> Any:
    """Selection of one of two images, or numbers, by a mask."""
    found = kernels.namespace(mask).where(mask, inside, outside)
    evaluate(found)
    return found


def pixelwise_max(one: Any, other: Any) -> Any:
    """Pixelwise maximum."""
    found = kernels.namespace(one).maximum(one, other)
    evaluate(found)
    return found


def subtract(image: Any, by: float) -> Any:
    """Image minus a number."""
    flat = flatten(image)
    return unflatten(flat - scalar(flat, by), image.shape)


def exceeds_shift(low: Any, high: Any, parallax_px_m: float, least_px: float) -> Any:
    """Pixels whose heights differ by so much that it shifts the image by more than ``least_px``."""
    low_flat, high_flat = flatten(low), flatten(high)
    shift = (high_flat - low_flat) * scalar(low_flat, parallax_px_m)
    return unflatten(shift > scalar(low_flat, least_px), low.shape)


def any_true(mask: Any) -> bool:
    """Whether any pixel of a mask is True."""
    return count_true(flatten(mask)) > 0


def min_max(image: Any) -> tuple[float, float] | None:
    """Minimum and maximum of an image; None where all are NaN."""
    known = _known(flatten(image))
    count = size_of(known)
    return (kth_smallest(known, 0), kth_smallest(known, count - 1)) if count else None


def _known(flat: Any) -> Any:
    return gather(flat, nonzero(~kernels.namespace(flat).isnan(flat)))


def median(image: Any) -> float:
    """Median of all pixels."""
    return _median(flatten(image))


def _median(flat: Any) -> float:
    count = size_of(flat)
    middle = kth_smallest(flat, count // 2)
    # As numpy has it, in float32.
    return middle if count % 2 else float(np.float32(middle) + np.float32(kth_smallest(flat, count // 2 - 1))) / 2.0


def median_above(image: Any, least: float) -> float | None:
    """Median of the pixels above a value; None without any."""
    flat = flatten(image)
    above = nonzero(flat > scalar(flat, least))
    return _median(gather(flat, above)) if size_of(above) else None


def newly_visible(device: Device, height: Any, num_agreeing: Any | None) -> np.ndarray:
    """Pixels with a height that no steeper view has, dilated by a pixel; see `images_host`."""
    flat = flatten(height)
    is_selected = ~kernels.namespace(flat).isnan(flat)
    if num_agreeing is not None:
        is_selected = is_selected & (flatten(num_agreeing) == 0.0)
    mask = as_numpy(to_float(is_selected)).reshape(height.shape)
    return cv2.dilate(mask, images_host.NEIGHBOURHOOD) > 0.0


def agreement_statistics(own: Any, sums: list[Any], shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """Number of peers that agree, mean height [m] and standard deviation [m] from the sums of `compare_heights`."""
    xp, (count, total, square) = kernels.namespace(own), sums
    mean = total / (count + 1.0)
    spread = xp.sqrt(xp.maximum(square / (count + 1.0) - mean * mean, 0.0))
    found = [to_float(count), own + mean, spread]
    evaluate(*found)
    count, mean, spread = (unflatten(each, shape) for each in found) if len(shape) > 1 else found
    return count, mean, spread


def mask_scores(device: Device, photograph: np.ndarray, score: Any) -> Any:
    """Scores, -1 at pixels left out of a photograph of the host."""
    flat = flatten(score)
    xp = kernels.namespace(flat)
    return unflatten(xp.where(xp.isnan(floats(device, photograph)), -1.0, flat), score.shape)


def grey(stack: ViewStack, view: int, strip: tuple[slice, slice]) -> Any:
    """Grey levels of a part of a photograph."""
    return gather(stack.pixels[view], strip_indices(stack.device, strip, stack.width_of(view)))


def grey_at(stack: ViewStack, view: int, pixels: Any) -> Any:
    """Grey levels of some pixels of a photograph, flat."""
    return gather(stack.pixels[view], pixels)


def heights_at(stack: ViewStack, view: int, pixels: Any | None) -> Any:
    """Heights of a stack of height maps: of all pixels of a view, or of some."""
    return stack.pixels[view] if pixels is None else grey_at(stack, view, pixels)


def crop(image: Any, strip: tuple[slice, slice]) -> Any:
    """A part of an image, flat."""
    flat = flatten(image)
    return gather(flat, _places(flat, strip, image.shape[1]))


def strip_indices(device: Device, strip: tuple[slice, slice], width: int) -> Any:
    """Flat indices of a part of an image of a width."""
    return _places(floats(device, np.zeros(1)), strip, width)


def _places(like: Any, strip: tuple[slice, slice], width: int) -> Any:
    rows, columns = (each.stop - each.start for each in strip)
    index = arange(like, rows * columns)
    row = index // scalar(like, columns)
    column = index - row * scalar(like, columns)
    first = strip[0].start * width + strip[1].start
    found = row * scalar(like, width) + column + scalar(like, first)
    evaluate(found)
    return found


def indices_of(mask: Any) -> Any:
    """Flat indices of the True pixels of a mask."""
    return nonzero(flatten(mask))


def values_at(flat: Any, pixels: Any) -> Any:
    """Flat pixels at indices."""
    return gather(flat, pixels)


def put(target: Any, pixels: Any, values: Any, mask: Any | None = None) -> None:
    """Set flat pixels at indices, where an optional mask is True."""
    scatter(target, pixels, values, mask)
    evaluate(target)


def put_strip(target: Any, width: int, result: Any, part: tuple[slice, slice], strip: slice, radius: int) -> None:
    """Copy the wanted rows and columns of a strip's results into a flat image of ``width`` columns."""
    rows, columns = part
    wide, left = strip.stop - strip.start, strip.start
    lost = radius * (wide + 1)
    local = slice(radius, radius + rows.stop - rows.start), slice(columns.start - left, columns.stop - left)
    values = gather(result, _places(result, local, wide) - scalar(result, lost))
    scatter(target, _places(target, part, width), values)
    evaluate(target)


def _in_tiles(like: Any, tiles: ImageTiles, part: slice) -> tuple[Any, Place, Place]:
    """Number of the tile, row and column in the image, and in the tile with its halo, of the pixels of tiles."""
    count, side = part.stop - part.start, tiles.side
    index = arange(like, count * side * side)
    tile = index // scalar(like, side * side)
    row = (index - tile * scalar(like, side * side)) // scalar(like, side)
    column = index - tile * scalar(like, side * side) - row * scalar(like, side)
    corner = [gather(vector(like, each), tile) for each in tiles.corners(part).T]
    return tile, (corner[0] + row, corner[1] + column), (row, column)


def tile_indices(device: Device, tiles: ImageTiles, part: slice) -> Any:
    """Flat indices of the pixels of tiles with their halo, tile by tile."""
    like = floats(device, np.zeros(1))
    _, (row, column), _ = _in_tiles(like, tiles, part)
    found = row * scalar(like, tiles.wanted.shape[1]) + column
    evaluate(found)
    return found


def tile_starts(device: Device, tiles: ImageTiles, part: slice) -> Any:
    """Lowest hypotheses [m] of the same pixels."""
    like = floats(device, np.zeros(1))
    tile, place, _ = _in_tiles(like, tiles, part)
    start = gather(vector(like, tiles.start[part]), tile)
    for axis, line in enumerate(place):
        middle = tiles.size * (tiles.place[part, axis] + 0.5) - 0.5
        slope = gather(vector(like, tiles.slope[part, axis]), tile)
        start = start + (to_float(line) - gather(vector(like, middle), tile)) * slope
    evaluate(start)
    return start


def trim_halo(flat: Any, lost: int) -> Any:
    """Drop ``lost`` values at each end, as the kernels do."""
    return gather(flat, arange(flat, size_of(flat) - 2 * lost) + scalar(flat, lost))


def own_pixels(device: Device, tiles: ImageTiles, part: slice, pixels: Any, lost: int) -> Any:
    """Mask of the pixels that are wanted, in their own tile, and have a whole window in it."""
    like = floats(device, np.zeros(1))
    tile, place, local = _in_tiles(like, tiles, part)
    found = gather(flatten(tiles.wanted), pixels)
    for axis, (line, inner) in enumerate(zip(place, local, strict=True)):
        tile_place = gather(vector(like, tiles.place[part, axis]), tile)
        found = found & (line // scalar(like, tiles.size) == tile_place)
        found = found & (inner >= tiles.radius) & (inner < tiles.side - tiles.radius)
    evaluate(found)
    return trim_halo(found, lost)
