"""Image filters on device arrays, written once for Dr.Jit and torch.

They look up the pixels around each, and give what OpenCV's give in `fields.sweep.images_host`, but for rounding.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np

from fields.sweep import images_host
from fields.sweep.kernels.arrays import (
    arange,
    as_numpy,
    count_true,
    evaluate,
    flatten,
    gather,
    integer_part,
    is_torch,
    kth_smallest,
    nonzero,
    scalar,
    size_of,
    to_float,
    unflatten,
)
from fields.sweep.planes import SIDE_PX, Sums, plane_through
from refract import kernels

# Length of a step along a row or column, across both, and of a knight's move [px], in whole 65536ths (Borgefors 1986).
STEPS = tuple(round(length * 2**16) / 2**16 for length in (1.0, 1.4, 2.1969))
# Images have fewer than half as many rows, and no more columns: the numbers of `_scan_rank` fit into 32 bits.
_FAR = 2**15
# Row and column (N,) of pixels.
Place = tuple[Any, Any]
# Border mode: maps a row or column that may lie outside an image of so many to one inside.
Rim = Callable[[Any, int], Any]


def places(like: Any, shape: tuple[int, ...]) -> Place:
    """Row and column of all pixels of an image (height, width), on the device of an array."""
    index, width = arange(like, math.prod(shape)), scalar(like, shape[1])
    row = index // width
    return row, index - row * width


def _clamped(line: Any, length: int) -> Any:
    """Border mode: replicate."""
    xp = kernels.namespace(line)
    return xp.minimum(xp.maximum(line, 0), scalar(line, length - 1))


def _mirrored(line: Any, length: int) -> Any:
    """Border mode: reflect about the centre of the outermost pixel."""
    last = scalar(line, length - 1)
    return abs(last - abs(last - abs(line)))


def _shifted(flat: Any, shape: tuple[int, int], place: Place, by: tuple[Any, Any], rim: Rim = _clamped) -> Any:
    """Pixels of an image at an offset in rows and columns."""
    row, column = (rim(line + step, length) for line, step, length in zip(place, by, shape, strict=True))
    return gather(flat, row * scalar(row, shape[1]) + column)


def median_blur(image: Any, side: int) -> Any:
    """Median filter of 3 or 5 pixels a side; replicated border."""
    flat, place, reach = flatten(image), places(image, image.shape), range(-(side // 2), side // 2 + 1)
    return unflatten(
        _pixelwise_median([_shifted(flat, image.shape, place, (y, x)) for y in reach for x in reach]), image.shape
    )


def _pixelwise_median(values: list[Any]) -> Any:
    """Pixelwise median of an odd number of arrays by Batcher's sorting network (Knuth 5.2.2, algorithm M)."""
    xp, values = kernels.namespace(values[0]), list(values)
    for one, other in _sorting_network(len(values)):
        low, high = xp.minimum(values[one], values[other]), xp.maximum(values[one], values[other])
        values[one], values[other] = low, high
    return values[len(values) // 2]


def _sorting_network(count: int) -> list[tuple[int, int]]:
    """Compare-exchange pairs of the sorting network of so many values, in order."""
    found, first = [], 1 << (count - 1).bit_length() - 1
    part = first
    while part:
        far, residue, distance = first, 0, part
        while True:
            found += [(n, n + distance) for n in range(count - distance) if n & part == residue]
            if far == part:
                break
            distance, far, residue = far - part, far >> 1, part
        part >>= 1
    return found


def local_min_max(height: Any, radius: int) -> tuple[Any, Any]:
    """Minimum and maximum height within a radius [px] of each pixel, after a median filter."""
    height = median_blur(height, 3)
    xp, reach = kernels.namespace(height), range(-radius, radius + 1)

    def within(pick: Callable[[Any, Any], Any]) -> Any:
        flat, place = flatten(height), places(height, height.shape)
        for axis_step in ((1, 0), (0, 1)):
            lines = [_shifted(flat, height.shape, place, (axis_step[0] * by, axis_step[1] * by)) for by in reach]
            flat = lines[0]
            for each in lines[1:]:
                flat = pick(flat, each)
            evaluate(flat)
        return unflatten(flat, height.shape)

    return within(xp.minimum), within(xp.maximum)


def upsample(height: Any, shape: tuple[int, int]) -> Any:
    """Heights of a coarser pass at another shape, bilinear, after a median filter."""
    if tuple(height.shape) == shape:
        return height
    flat, place = flatten(height), places(height, shape)
    (top, below, down), (first, right, across) = (
        _between(line, length, target) for line, length, target in zip(place, height.shape, shape, strict=True)
    )
    width = scalar(flat, height.shape[1])
    a, b, c, d = (gather(flat, row * width + column) for row in (top, below) for column in (first, right))
    upper, lower = a + across * (b - a), c + across * (d - c)
    return median_blur(unflatten(upper + down * (lower - upper), shape), images_host.SINGLE_PX)


def _between(line: Any, length: int, target: int) -> tuple[Any, Any, Any]:
    """Lower and upper line of a smaller image for each line of a larger one, and the fraction between them."""
    xp = kernels.namespace(line)
    at = (to_float(line) + 0.5) * scalar(line, float(np.float32(length / target))) - 0.5
    at = xp.minimum(xp.maximum(at, 0.0), scalar(line, float(length - 1)))
    first = integer_part(at)
    return first, _clamped(first + 1, length), at - to_float(first)


def masked_means(value: Any, counts: Any, shape: tuple[int, int]) -> Any:
    """Means of the masked values over the areas of larger pixels, (height, width); NaN where none is."""
    known = to_float(flatten(counts))
    share, total = (_area_sums(each, value.shape, shape) for each in (known, known * flatten(value)))
    xp = kernels.namespace(share)
    return unflatten(xp.where(share > 0.0, total / xp.maximum(share, 1e-6), math.nan), shape)


def _area_sums(flat: Any, shape: tuple[int, int], target: tuple[int, int]) -> Any:
    """Means over the areas of larger pixels, along columns, then along rows."""
    for axis, size in enumerate(target):
        before, shape = shape, (size, shape[1]) if axis == 0 else (shape[0], size)
        place = list(places(flat, shape))
        xp, side, total = kernels.namespace(flat), before[axis] / size, None
        low = to_float(place[axis]) * scalar(flat, side)
        first = integer_part(low)
        for step in range(math.ceil(side) + 1):
            line = first + step
            begin = to_float(line)
            share = xp.minimum(begin + 1.0, low + scalar(flat, side)) - xp.maximum(begin, low)
            place[axis] = _clamped(line, before[axis])
            part = xp.maximum(share, 0.0) * gather(flat, place[0] * scalar(flat, before[1]) + place[1])
            total = part if total is None else total + part
        flat = total * scalar(flat, 1.0 / side)
        evaluate(flat)
    return flat


def fill_nearest(height: Any, known: Any) -> Any:
    """Heights with unknown ones replaced by that of the nearest known pixel, or of one about as near.

    By jumping from pixel to pixel in steps that halve (Rong and Tan 2006). Ties are frequent, and broken in OpenCV's
    order: above first, below before right.
    """
    flat, mask, shape = flatten(height), flatten(known), height.shape
    if not 0 < count_true(mask) < size_of(flat):
        return height
    place, xp = places(flat, shape), kernels.namespace(flat)
    nowhere = scalar(flat, 4.0 * max(shape))
    nearest = [xp.where(mask, to_float(line), nowhere) for line in place]
    evaluate(*place, *nearest)
    last, width = tuple(scalar(place[0], length - 1) for length in shape), scalar(place[0], shape[1])
    jump = _jump if is_torch(flat) else _recorded_jump()
    # Steps of one pixel twice: with one, the distance of one pixel in a thousand is a third too large.
    for length in [*(1 << bit for bit in reversed(range(max(shape).bit_length()))), 1]:
        nearest = jump(place, nearest, scalar(place[0], length), last, width)
    rows, columns = (integer_part(each) for each in nearest)
    return unflatten(gather(flat, rows * scalar(flat, shape[1]) + columns), shape)


def _jump(place: Place, nearest: list[Any], reach: Any, last: tuple[Any, Any], width: Any) -> list[Any]:
    """Row and column of the nearest known pixel, among the candidates of a pixel and of eight others at a distance."""
    xp = kernels.namespace(nearest[0])
    distance, rank = _distance(place, nearest), _scan_rank(place, nearest)
    for y, x in ((y, x) for y in (-1, 0, 1) for x in (-1, 0, 1) if y or x):
        row, column = (
            xp.minimum(xp.maximum(line + step * reach, 0), end)
            for line, step, end in zip(place, (y, x), last, strict=True)
        )
        candidates = [gather(each, row * width + column) for each in nearest]
        other, later = _distance(place, candidates), _scan_rank(place, candidates)
        better = (other < distance) | ((other == distance) & (later < rank))
        nearest = [xp.where(better, new, old) for new, old in zip(candidates, nearest, strict=True)]
        distance, rank = xp.minimum(distance, other), xp.where(better, later, rank)
    return nearest


@cache
def _recorded_jump() -> Callable[..., list[Any]]:
    """`_jump` by Dr.Jit, traced once: to trace a step takes longer than a GPU needs for it."""
    import drjit

    return drjit.freeze(_jump)


def _distance(place: Place, other: list[Any]) -> Any:
    """Chamfer distance [px] of pixels with straight, diagonal and knight's-move steps, as OpenCV has it."""
    xp = kernels.namespace(other[0])
    row, column = (abs(to_float(line) - each) for line, each in zip(place, other, strict=True))
    far, near = xp.maximum(row, column), xp.minimum(row, column)
    straight, across, knight = STEPS
    return xp.where(
        far > 2.0 * near,
        (far - 2.0 * near) * straight + near * knight,
        (2.0 * near - far) * across + (far - near) * knight,
    )


def _scan_rank(place: Place, other: list[Any]) -> Any:
    """Rank of pixels in OpenCV's scans of the distance transform: down the image, up, last in a row."""
    xp = kernels.namespace(other[0])
    down, right = (integer_part(each - to_float(line)) for line, each in zip(place, other, strict=True))
    order, part = down * _FAR + right, _FAR * _FAR // 2
    on_way_down = ((down < 0) & (right <= -2 * down)) | ((down == 0) & (right < 0))
    return xp.where(on_way_down, order - part, xp.where(down > 0, -order, order + part))


def _over_tiles(
    flat: Any, shape: tuple[int, int], size: int, join: Callable[[Any, Any], Any], beyond: float | None = None
) -> np.ndarray:
    """Reduction over the pixels of each tile, (rows, columns) float64 on the host: along rows, then columns.

    Tiles beyond the image are padded with its outermost pixels, or with a value.
    """
    evaluate(flat)
    xp = kernels.namespace(flat)
    for axis in (1, 0):
        before, count = shape, -(-shape[axis] // size)
        shape = (shape[0], count) if axis else (count, shape[1])
        place = list(places(flat, shape))
        first, total = place[axis] * scalar(flat, size), None
        for step in range(size):
            line = first + step
            place[axis] = _clamped(line, before[axis])
            part = gather(flat, place[0] * scalar(flat, before[1]) + place[1])
            if beyond is not None:
                part = xp.where(line < scalar(flat, before[axis]), part, beyond)
            total = part if total is None else join(total, part)
        flat = total
        evaluate(flat)
    return as_numpy(flat).reshape(shape).astype(np.float64)


def tile_extents(wanted: Any, low: Any, high: Any, size: int) -> tuple[np.ndarray, np.ndarray]:
    """Least low and largest high value of the wanted pixels of each tile, (rows, columns); inf if none."""
    xp, mask = kernels.namespace(low), flatten(wanted)
    least = _over_tiles(xp.where(mask, flatten(low), math.inf), low.shape, size, xp.minimum)
    return least, _over_tiles(xp.where(mask, flatten(high), -math.inf), low.shape, size, xp.maximum)


def tile_gradients(height: Any, wanted: Any, size: int) -> np.ndarray:
    """Gradient of smoothed heights, summed over tiles; see `images_host`."""
    height = median_blur(height, 3)
    shape, place, half = height.shape, places(height, height.shape), images_host.SMOOTH_PX // 2
    flat, mask = flatten(height), flatten(wanted)
    for axis_step in ((1, 0), (0, 1)):
        lines = (
            _shifted(flat, shape, place, (axis_step[0] * by, axis_step[1] * by), _mirrored)
            for by in range(-half, half + 1)
        )
        flat = sum(lines) * (1.0 / images_host.SMOOTH_PX)
        evaluate(flat)
    xp, found = kernels.namespace(flat), []
    for axis_step in ((1, 0), (0, 1)):
        # Sobel's kernel.
        asides = (
            (2.0 - abs(by), [_step(flat, shape, place, axis_step, by, step) for step in (1, -1)]) for by in (-1, 0, 1)
        )
        rise = sum(weight * (after - before) for weight, (after, before) in asides)
        rise = xp.where(mask, rise, 0.0)
        found.append(_over_tiles(rise, shape, size, lambda one, other: one + other, 0.0))
    return np.stack(found, axis=-1)


def _step(flat: Any, shape: tuple[int, int], place: Place, axis_step: tuple[int, int], offset: int, by: int) -> Any:
    """Pixel a step farther along an axis, and an offset across it."""
    return _shifted(flat, shape, place, (by, offset) if axis_step[0] else (offset, by), _mirrored)


def extrapolate_planes(height: Any, known: Any, tolerance: float) -> Any:
    """`fields.sweep.planes.extrapolate_planes`."""
    flat, mask, shape = flatten(height), flatten(known), height.shape
    if not 0 < count_true(mask) < size_of(flat):
        return height
    place, xp, half = places(flat, shape), kernels.namespace(flat), SIDE_PX // 2

    def along(values: Any, power: int, axis: int) -> Any:
        total: Any = 0.0
        for by in range(-half, half + 1):
            if power and not by:
                continue
            line = place[axis] + by
            inside = (line >= 0) & (line < scalar(line, shape[axis]))
            part = _shifted(values, shape, place, (by, 0) if axis == 0 else (0, by))
            total = total + xp.where(inside, part, 0.0) * float(by**power)
        evaluate(total)
        return total

    weight = to_float(mask)
    # Any of the heights serves as the base: float32 holds the differences.
    base = scalar(flat, kth_smallest(gather(flat, nonzero(mask)), 0))
    height_over = weight * (flat - base)
    evaluate(weight, height_over)
    plane, off = plane_through(Sums.of(weight, height_over, along))
    return unflatten(xp.where(~mask & (off < scalar(flat, tolerance)), base + plane, flat), shape)
