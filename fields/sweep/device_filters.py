"""Filters of images that lie in the memory of a device: written once for Dr.Jit and torch.

They look up the pixels around each, and give what OpenCV's give in `fields.sweep.images_host`, but for rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from fields.sweep import images_host
from fields.sweep.kernels.flat import (
    computed,
    counted,
    flat_of,
    given,
    image_of,
    numbers,
    on_host,
    ranked,
    real,
    size_of,
    taken,
    where_true,
)
from fields.sweep.planes import SIDE_PX, Sums, plane_through
from refract import kernels

# Length of a step along a row or column, across both, and of a knight's move [px], in whole 65536ths (Borgefors 1986).
STEPS = tuple(round(length * 2**16) / 2**16 for length in (1.0, 1.4, 2.1969))
# Images have fewer than half as many rows, and no more columns: the numbers of `_turn` fit into 32 bits.
_FAR = 2**15
# Row and column (N,) of pixels.
Place = tuple[Any, Any]
# A line within so many of an image, for one that may lie beyond.
Rim = Callable[[Any, int], Any]


def places(like: Any, shape: tuple[int, ...]) -> Place:
    """Row and column of all pixels of an image (height, width), where an array is."""
    index, width = numbers(like, math.prod(shape)), given(like, shape[1])
    row = index // width
    return row, index - row * width


def _clamped(line: Any, length: int) -> Any:
    """The rim repeats."""
    xp = kernels.namespace(line)
    return xp.minimum(xp.maximum(line, 0), given(line, length - 1))


def _mirrored(line: Any, length: int) -> Any:
    """The image is mirrored at the middle of its outermost pixels."""
    last = given(line, length - 1)
    return abs(last - abs(last - abs(line)))


def _beside(flat: Any, shape: tuple[int, int], place: Place, by: tuple[Any, Any], rim: Rim = _clamped) -> Any:
    """The pixels of an image so many rows and columns farther."""
    row, column = (rim(line + step, length) for line, step, length in zip(place, by, shape, strict=True))
    return taken(flat, row * given(row, shape[1]) + column)


def median_blur(image: Any, side: int) -> Any:
    """Medians over squares of 3 or 5 pixels; the rim repeats."""
    flat, place, reach = flat_of(image), places(image, image.shape), range(-(side // 2), side // 2 + 1)
    return image_of(_middle([_beside(flat, image.shape, place, (y, x)) for y in reach for x in reach]), image.shape)


def _middle(values: list[Any]) -> Any:
    """The median of an odd number of arrays, each pixel for itself, by Batcher's network (Knuth 5.2.2, algorithm M)."""
    xp, values = kernels.namespace(values[0]), list(values)
    for one, other in _exchanges(len(values)):
        low, high = xp.minimum(values[one], values[other]), xp.maximum(values[one], values[other])
        values[one], values[other] = low, high
    return values[len(values) // 2]


def _exchanges(count: int) -> list[tuple[int, int]]:
    """Which of so many values are brought into order, one pair after the other, until all are."""
    found, first = [], 1 << (count - 1).bit_length() - 1
    part = first
    while part:
        far, rest, apart = first, 0, part
        while True:
            found += [(n, n + apart) for n in range(count - apart) if n & part == rest]
            if far == part:
                break
            apart, far, rest = far - part, far >> 1, part
        part >>= 1
    return found


def around(height: Any, radius: int) -> tuple[Any, Any]:
    """Lowest and highest height within a radius [px] of each pixel, without single wrong ones."""
    height = median_blur(height, 3)
    xp, reach = kernels.namespace(height), range(-radius, radius + 1)

    def within(pick: Callable[[Any, Any], Any]) -> Any:
        flat, place = flat_of(height), places(height, height.shape)
        for way in ((1, 0), (0, 1)):
            lines = [_beside(flat, height.shape, place, (way[0] * by, way[1] * by)) for by in reach]
            flat = lines[0]
            for each in lines[1:]:
                flat = pick(flat, each)
            computed(flat)
        return image_of(flat, height.shape)

    return within(xp.minimum), within(xp.maximum)


def enlarged(height: Any, shape: tuple[int, int]) -> Any:
    """Heights of a coarser pass at another shape, without the single wrong ones."""
    if tuple(height.shape) == shape:
        return height
    flat, here = flat_of(height), places(height, shape)
    (top, below, down), (first, right, across) = (
        _between(line, length, target) for line, length, target in zip(here, height.shape, shape, strict=True)
    )
    width = given(flat, height.shape[1])
    a, b, c, d = (taken(flat, row * width + column) for row in (top, below) for column in (first, right))
    upper, lower = a + across * (b - a), c + across * (d - c)
    return median_blur(image_of(upper + down * (lower - upper), shape), images_host.SINGLE_PX)


def _between(line: Any, length: int, target: int) -> tuple[Any, Any, Any]:
    """The lines of a smaller image on either side of those of a larger one, and the way from the first to it."""
    xp = kernels.namespace(line)
    at = (real(line) + 0.5) * given(line, float(np.float32(length / target))) - 0.5
    at = xp.minimum(xp.maximum(at, 0.0), given(line, float(length - 1)))
    first = _whole(at)
    return first, _clamped(first + 1, length), at - real(first)


def _whole(values: Any) -> Any:
    """Whole numbers of values that are whole, or those below values that are not negative."""
    return values.long() if kernels.namespace(values).name == "torch" else type(numbers(values, 1))(values)


def means_of(value: Any, counts: Any, shape: tuple[int, int]) -> Any:
    """Means over the areas of larger pixels of what counts, (height, width); NaN where nothing does."""
    known = real(flat_of(counts))
    share, total = (_area_sums(each, value.shape, shape) for each in (known, known * flat_of(value)))
    xp = kernels.namespace(share)
    return image_of(xp.where(share > 0.0, total / xp.maximum(share, 1e-6), math.nan), shape)


def _area_sums(flat: Any, shape: tuple[int, int], target: tuple[int, int]) -> Any:
    """Means over the areas of larger pixels, first down, then across."""
    for axis, size in enumerate(target):
        before, shape = shape, (size, shape[1]) if axis == 0 else (shape[0], size)
        place = list(places(flat, shape))
        xp, side, total = kernels.namespace(flat), before[axis] / size, None
        low = real(place[axis]) * given(flat, side)
        first = _whole(low)
        for step in range(math.ceil(side) + 1):
            line = first + step
            begin = real(line)
            share = xp.minimum(begin + 1.0, low + given(flat, side)) - xp.maximum(begin, low)
            place[axis] = _clamped(line, before[axis])
            part = xp.maximum(share, 0.0) * taken(flat, place[0] * given(flat, before[1]) + place[1])
            total = part if total is None else total + part
        flat = total * given(flat, 1.0 / side)
        computed(flat)
    return flat


def filled(height: Any, known: Any) -> Any:
    """Heights in which unknown ones are replaced by that of the nearest known pixel, or of one about as near.

    By jumping from pixel to pixel in steps that halve (Rong and Tan 2006). Many pixels have several that are as near:
    then OpenCV's counts, which looks for those above first, and for those below before it looks to the right.
    """
    flat, mask, shape = flat_of(height), flat_of(known), height.shape
    if not 0 < counted(mask) < size_of(flat):
        return height
    place, xp = places(flat, shape), kernels.namespace(flat)
    nowhere = given(flat, 4.0 * max(shape))
    nearest = [xp.where(mask, real(line), nowhere) for line in place]
    computed(*nearest)
    # Steps of one pixel twice: of what is found otherwise one pixel in a thousand is a third too far away.
    for length in [*(1 << bit for bit in reversed(range(max(shape).bit_length()))), 1]:
        reach = given(flat, length)
        distance, turn = _distance(place, nearest), _turn(place, nearest)
        for y, x in ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x):
            there = [_beside(each, shape, place, (y * reach, x * reach)) for each in nearest]
            other, later = _distance(place, there), _turn(place, there)
            better = (other < distance) | ((other == distance) & (later < turn))
            nearest = [xp.where(better, new, old) for new, old in zip(there, nearest, strict=True)]
            distance, turn = xp.minimum(distance, other), xp.where(better, later, turn)
        computed(*nearest)
    rows, columns = (_whole(each) for each in nearest)
    return image_of(taken(flat, rows * given(flat, shape[1]) + columns), shape)


def _distance(place: Place, other: list[Any]) -> Any:
    """Of pixels [px], by steps along rows and columns, across both, and by a knight's move, as OpenCV has it."""
    xp = kernels.namespace(other[0])
    row, column = (abs(real(line) - each) for line, each in zip(place, other, strict=True))
    far, near = xp.maximum(row, column), xp.minimum(row, column)
    straight, across, knight = STEPS
    return xp.where(
        far > 2.0 * near,
        (far - 2.0 * near) * straight + near * knight,
        (2.0 * near - far) * across + (far - near) * knight,
    )


def _turn(place: Place, other: list[Any]) -> Any:
    """When OpenCV comes to pixels, as numbers that rise: on its way down the image, on its way up, or last in a row."""
    xp = kernels.namespace(other[0])
    down, right = (_whole(each - real(line)) for line, each in zip(place, other, strict=True))
    order, part = down * _FAR + right, given(down, _FAR * _FAR // 2)
    on_way_down = ((down < 0) & (right <= -2 * down)) | ((down == 0) & (right < 0))
    return xp.where(on_way_down, order - part, xp.where(down > 0, -order, order + part))


def _over_tiles(
    flat: Any, shape: tuple[int, int], size: int, join: Callable[[Any, Any], Any], beyond: float | None = None
) -> np.ndarray:
    """What all pixels of each tile come to, (rows, columns) float64 of the host: along rows, then columns.

    Beyond the image its outermost pixels count once more, or a value does.
    """
    computed(flat)
    xp = kernels.namespace(flat)
    for axis in (1, 0):
        before, count = shape, -(-shape[axis] // size)
        shape = (shape[0], count) if axis else (count, shape[1])
        place = list(places(flat, shape))
        first, total = place[axis] * given(flat, size), None
        for step in range(size):
            line = first + step
            place[axis] = _clamped(line, before[axis])
            part = taken(flat, place[0] * given(flat, before[1]) + place[1])
            if beyond is not None:
                part = xp.where(line < given(flat, before[axis]), part, beyond)
            total = part if total is None else join(total, part)
        flat = total
        computed(flat)
    return on_host(flat).reshape(shape).astype(np.float64)


def extent(wanted: Any, low: Any, high: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Least of the low and most of the high values of the wanted pixels of each tile, (rows, columns); inf without."""
    xp, mask = kernels.namespace(low), flat_of(wanted)
    least = _over_tiles(xp.where(mask, flat_of(low), math.inf), low.shape, size, xp.minimum)
    return least, _over_tiles(xp.where(mask, flat_of(high), -math.inf), low.shape, size, xp.maximum)


def ways(height: Any, wanted: Any, size: int) -> np.ndarray:
    """By how much smoothed heights rise from row to row and from column to column; see the twin."""
    height = median_blur(height, 3)
    shape, place, half = height.shape, places(height, height.shape), images_host.SMOOTH_PX // 2
    flat, mask = flat_of(height), flat_of(wanted)
    for way in ((1, 0), (0, 1)):
        lines = (_beside(flat, shape, place, (way[0] * by, way[1] * by), _mirrored) for by in range(-half, half + 1))
        flat = sum(lines) * (1.0 / images_host.SMOOTH_PX)
        computed(flat)
    xp, found = kernels.namespace(flat), []
    for way in ((1, 0), (0, 1)):
        # Sobel's kernel.
        asides = ((2.0 - abs(by), [_step(flat, shape, place, way, by, step) for step in (1, -1)]) for by in (-1, 0, 1))
        rise = sum(weight * (after - before) for weight, (after, before) in asides)
        rise = xp.where(mask, rise, 0.0)
        found.append(_over_tiles(rise, shape, size, lambda one, other: one + other, 0.0))
    return np.stack(found, axis=-1)


def _step(flat: Any, shape: tuple[int, int], place: Place, way: tuple[int, int], aside: int, by: int) -> Any:
    """The pixel a step farther along a way, and some beside it."""
    return _beside(flat, shape, place, (by, aside) if way[0] else (aside, by), _mirrored)


def on_planes(height: Any, known: Any, tolerance: float) -> Any:
    """`fields.sweep.planes.continued`."""
    flat, mask, shape = flat_of(height), flat_of(known), height.shape
    if not 0 < counted(mask) < size_of(flat):
        return height
    place, xp, half = places(flat, shape), kernels.namespace(flat), SIDE_PX // 2

    def along(values: Any, power: int, axis: int) -> Any:
        total: Any = 0.0
        for by in range(-half, half + 1):
            if power and not by:
                continue
            line = place[axis] + by
            inside = (line >= 0) & (line < given(line, shape[axis]))
            part = _beside(values, shape, place, (by, 0) if axis == 0 else (0, by))
            total = total + xp.where(inside, part, 0.0) * float(by**power)
        computed(total)
        return total

    weight = real(mask)
    # Any height among them does: float32 holds what is left.
    base = given(flat, ranked(taken(flat, where_true(mask)), 0))
    height_over = weight * (flat - base)
    computed(weight, height_over)
    plane, off = plane_through(Sums.of(weight, height_over, along))
    return image_of(xp.where(~mask & (off < given(flat, tolerance)), base + plane, flat), shape)
