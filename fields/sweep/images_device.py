"""Images between the kernels of the sweep on a device with a memory of its own: they stay there between the passes.

The twin of `fields.sweep.images_host`, written once for Dr.Jit and torch: images are their tensors (height, width).
What the host is told are numbers (a median, whether a mask holds anywhere), which tiles are climbed, and which parts of
a view become points.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np

from fields.device import Device
from fields.sweep import device_filters, images_host
from fields.sweep.device_filters import Place
from fields.sweep.kernels.arrays import floats
from fields.sweep.kernels.flat import (
    all_given,
    computed,
    copied,
    counted,
    filled_with,
    flat_of,
    given,
    image_of,
    numbers,
    on_host,
    ranked,
    real,
    scattered,
    size_of,
    taken,
    where_true,
)
from fields.sweep.kernels.stack import ViewStack
from fields.sweep.maps import DepthMap
from fields.sweep.tiles import Tiles
from refract import kernels

# The rest of `fields.sweep.images.Images`.
around, enlarged, extent = device_filters.around, device_filters.enlarged, device_filters.extent
filled, means_of, median_blur = device_filters.filled, device_filters.means_of, device_filters.median_blur
on_planes, ways = device_filters.on_planes, device_filters.ways


def arrived(device: Device, m: DepthMap) -> DepthMap:
    """A map of the host as the sweep works on it: all of it float32."""
    arrays = (m.height, m.score, m.agreeing, m.spread)
    return DepthMap(m.view, *(image_of(floats(device, each), each.shape) for each in arrays))


def left(m: DepthMap) -> DepthMap:
    """A map as the host keeps it."""
    kinds = (np.float32, np.float16, np.uint8, np.float16)
    arrays = (m.height, m.score, m.agreeing, m.spread)
    return DepthMap(m.view, *(on_host(each).astype(kind) for each, kind in zip(arrays, kinds, strict=True)))


def placed(device: Device, image: np.ndarray) -> Any:
    """An image of the host, float32 or bool."""
    flat = floats(device, image)
    return image_of(flat > 0.0 if image.dtype == bool else flat, image.shape)


def fetched(image: Any) -> np.ndarray:
    """An image, or flat pixels, in the memory of the host."""
    return on_host(image)


def found_map(view: int, height: Any, score: Any) -> DepthMap:
    """What a pass found of a view, which no other has confirmed yet."""
    flat = flat_of(height)
    nobody, spread = (image_of(filled_with(flat, 0.0, size_of(flat)), height.shape) for _ in range(2))
    return DepthMap(view, height, score, nobody, spread)


def brief(image: Any) -> Any:
    """Scores or spreads as maps keep them."""
    return image


def full(device: Device, shape: tuple[int, int], value: float) -> Any:
    """An image of one value."""
    return image_of(filled_with(floats(device, np.zeros(1)), value, math.prod(shape)), shape)


def flat_copy(image: Any) -> Any:
    """The pixels of an image, to be written to."""
    return copied(flat_of(image))


def pixels_of(image: Any) -> Any:
    """The pixels of an image, to be written to only where nobody else has it."""
    return flat_of(image)


def shaped(flat: Any, shape: tuple[int, int]) -> Any:
    """An image of flat pixels."""
    return image_of(flat, shape)


def where(mask: Any, there: Any, elsewhere: Any) -> Any:
    """One of two images, or numbers, by a mask."""
    found = kernels.namespace(mask).where(mask, there, elsewhere)
    computed(found)
    return found


def larger(one: Any, other: Any) -> Any:
    """The larger of two images, pixel by pixel."""
    found = kernels.namespace(one).maximum(one, other)
    computed(found)
    return found


def lowered(image: Any, by: float) -> Any:
    """An image less a number."""
    flat = flat_of(image)
    return image_of(flat - given(flat, by), image.shape)


def rising(low: Any, high: Any, parallax: float, least: float) -> Any:
    """Where heights differ by a parallax of more than a least one [px]."""
    low_flat, high_flat = flat_of(low), flat_of(high)
    return image_of((high_flat - low_flat) * given(low_flat, parallax) > given(low_flat, least), low.shape)


def is_any(mask: Any) -> bool:
    """Whether a mask holds anywhere."""
    return counted(flat_of(mask)) > 0


def extremes(image: Any) -> tuple[float, float] | None:
    """The least and the largest value of an image; None where all are NaN."""
    known = _known(flat_of(image))
    count = size_of(known)
    return (ranked(known, 0), ranked(known, count - 1)) if count else None


def _known(flat: Any) -> Any:
    return taken(flat, where_true(~kernels.namespace(flat).isnan(flat)))


def median(image: Any) -> float:
    """Of all pixels of an image."""
    return _median(flat_of(image))


def _median(flat: Any) -> float:
    count = size_of(flat)
    middle = ranked(flat, count // 2)
    # As numpy has it, in float32.
    return middle if count % 2 else float(np.float32(middle) + np.float32(ranked(flat, count // 2 - 1))) / 2.0


def median_above(image: Any, least: float) -> float | None:
    """Of the pixels of an image that are above a value; None without any."""
    flat = flat_of(image)
    above = where_true(flat > given(flat, least))
    return _median(taken(flat, above)) if size_of(above) else None


def first_shown(device: Device, height: Any, before: Any | None) -> np.ndarray:
    """Where heights are known that none of so many views before has, a pixel around it added: see the twin."""
    flat = flat_of(height)
    there = ~kernels.namespace(flat).isnan(flat)
    if before is not None:
        there = there & (flat_of(before) == 0.0)
    mask = on_host(real(there)).reshape(height.shape)
    return cv2.dilate(mask, images_host.BESIDE) > 0.0


def agreement(own: Any, sums: list[Any], shape: tuple[int, ...]) -> tuple[Any, Any, Any]:
    """How many other heights agree, the mean with them [m] and their standard deviation [m], of `compare`'s sums."""
    xp, (count, total, square) = kernels.namespace(own), sums
    mean = total / (count + 1.0)
    spread = xp.sqrt(xp.maximum(square / (count + 1.0) - mean * mean, 0.0))
    found = [real(count), own + mean, spread]
    computed(*found)
    count, mean, spread = (image_of(each, shape) for each in found) if len(shape) > 1 else found
    return count, mean, spread


def shown(device: Device, photograph: np.ndarray, score: Any) -> Any:
    """Scores, -1 at pixels left out of a photograph of the host."""
    flat = flat_of(score)
    xp = kernels.namespace(flat)
    return image_of(xp.where(xp.isnan(floats(device, photograph)), -1.0, flat), score.shape)


def grey(stack: ViewStack, view: int, strip: tuple[slice, slice]) -> Any:
    """Grey levels of a part of a photograph."""
    return taken(stack.pixels[view], places_in(stack.device, strip, stack.width))


def grey_at(stack: ViewStack, view: int, pixels: Any) -> Any:
    """Grey levels of some pixels of a photograph, flat."""
    return taken(stack.pixels[view], pixels)


def heights_at(stack: ViewStack, view: int, pixels: Any | None) -> Any:
    """Heights of a stack of height maps: of all pixels of a view, or of some."""
    return stack.pixels[view] if pixels is None else grey_at(stack, view, pixels)


def cut(image: Any, strip: tuple[slice, slice]) -> Any:
    """A part of an image, flat."""
    flat = flat_of(image)
    return taken(flat, _places(flat, strip, image.shape[1]))


def places_in(device: Device, strip: tuple[slice, slice], width: int) -> Any:
    """Flat indices of a part of an image of a width."""
    return _places(floats(device, np.zeros(1)), strip, width)


def _places(like: Any, strip: tuple[slice, slice], width: int) -> Any:
    rows, columns = (each.stop - each.start for each in strip)
    index = numbers(like, rows * columns)
    row = index // given(like, columns)
    column = index - row * given(like, columns)
    first = strip[0].start * width + strip[1].start
    found = row * given(like, width) + column + given(like, first)
    computed(found)
    return found


def places_of(mask: Any) -> Any:
    """Flat indices of what a mask has."""
    return where_true(flat_of(mask))


def at(flat: Any, pixels: Any) -> Any:
    """Some of flat pixels."""
    return taken(flat, pixels)


def put(target: Any, pixels: Any, values: Any, mask: Any | None = None) -> None:
    """Set some of flat pixels, or those of them that a mask has."""
    scattered(target, pixels, values, mask)


def put_strip(target: Any, width: int, result: Any, rows: slice, columns: slice, strip: slice, radius: int) -> None:
    """Set rows and columns of flat pixels, of a width, to the results of a strip that spans other columns."""
    wide, left = strip.stop - strip.start, strip.start
    lost = radius * (wide + 1)
    local = slice(radius, radius + rows.stop - rows.start), slice(columns.start - left, columns.stop - left)
    values = taken(result, _places(result, local, wide) - given(result, lost))
    scattered(target, _places(target, (rows, columns), width), values)


def _in_tiles(like: Any, tiles: Tiles, part: slice) -> tuple[Any, Place, Place]:
    """Number of the tile, row and column in the image, and in the tile with its halo, of the pixels of tiles."""
    count, side = part.stop - part.start, tiles.side
    index = numbers(like, count * side * side)
    tile = index // given(like, side * side)
    row = (index - tile * given(like, side * side)) // given(like, side)
    column = index - tile * given(like, side * side) - row * given(like, side)
    corner = [taken(all_given(like, each), tile) for each in tiles.corners(part).T]
    return tile, (corner[0] + row, corner[1] + column), (row, column)


def tile_pixels(device: Device, tiles: Tiles, part: slice) -> Any:
    """Flat indices of the pixels of tiles with their halo, tile by tile."""
    like = floats(device, np.zeros(1))
    _, (row, column), _ = _in_tiles(like, tiles, part)
    found = row * given(like, tiles.wanted.shape[1]) + column
    computed(found)
    return found


def tile_starts(device: Device, tiles: Tiles, part: slice) -> Any:
    """First rungs [m] of the same pixels."""
    like = floats(device, np.zeros(1))
    tile, place, _ = _in_tiles(like, tiles, part)
    start = taken(all_given(like, tiles.start[part]), tile)
    for axis, line in enumerate(place):
        middle = tiles.size * (tiles.place[part, axis] + 0.5) - 0.5
        slope = taken(all_given(like, tiles.slope[part, axis]), tile)
        start = start + (real(line) - taken(all_given(like, middle), tile)) * slope
    computed(start)
    return start


def whole_windows(flat: Any, lost: int) -> Any:
    """Of the pixels of tiles, those that results have: without so many at either end."""
    return taken(flat, numbers(flat, size_of(flat) - 2 * lost) + given(flat, lost))


def own(device: Device, tiles: Tiles, part: slice, pixels: Any, lost: int) -> Any:
    """Which of these are wanted, in their own tile, and have a whole window in it."""
    like = floats(device, np.zeros(1))
    tile, place, local = _in_tiles(like, tiles, part)
    found = taken(flat_of(tiles.wanted), pixels)
    for axis, (line, inner) in enumerate(zip(place, local, strict=True)):
        mine = taken(all_given(like, tiles.place[part, axis]), tile)
        found = found & (line // given(like, tiles.size) == mine)
        found = found & (inner >= tiles.radius) & (inner < tiles.side - tiles.radius)
    computed(found)
    return whole_windows(found, lost)
