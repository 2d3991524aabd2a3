"""Kernels in Dr.Jit: neighbour images warped along refracted rays, their NCC with a reference, and the best height.

One call takes a strip of rows of a reference view and the height hypotheses of each pixel. As these are offsets to a
*per-pixel* height, the window of each pixel follows the relief found so far.

    K neighbours, J hypotheses, P pixels of the strip (with a halo of the window's radius)
    W      neighbour intensity at (k, j, p): the bed point of pixel p at hypothesis j, seen by neighbour k
    NCC    of W and the reference (p) over a square window
    score  mean of the best half of the neighbours' NCC, per (j, p): an occluded neighbour scores low and drops out

One kernel projects points into several neighbours, whose cameras are its arguments: all points of the hypotheses, which
are computed once, or, where the hypotheses lie on one side of the water, three of them, by which another kernel finds
the others (`fields.sweep.kernels.rays`).

`ncc` and `best_half` are one kernel, which reads each window from W in vectors of neighbouring pixels, and writes the
score alone: nothing else goes through memory. Of wide windows, which have up to 289 pixels, sums over rows are written
first, and then added: the same sums in the same order, for 2 (2 radius + 1) additions in place of their square.

Callers get these functions from `fields.sweep.matching.kernels`; `torch_kernels` has the same without Dr.Jit.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from fields.device import Device
from fields.sweep.kernels import rays as geometry
from fields.sweep.kernels.arrays import Buffer, constant, floats, hypothesis_and_pixel, indices
from fields.sweep.kernels.stack import MASKED, NOISE_VARIANCE, Hypotheses, ViewStack

_MANY = 0.3  # Share of pixels that straddle the water from which on all points are projected
HYPOTHESES_PER_KERNEL = 8  # Hypotheses of one kernel of `best_height`: hundreds in one kernel take minutes to compile
# Windows of a larger radius [px] are added up by rows: smaller ones are read faster than their sums are written.
_WIDEST_AT_ONCE = 2
# Rows of a window of 5 px whose pixels, and those of the reference, AVX2 keeps in its 16 registers.
_ROWS_IN_REGISTERS = 2
_KNOWN_SUMS = 6  # Of windows of which a part is known: see `_known_row`


def sample_packed(stack: ViewStack, view: int, u, v, inside):
    """Bilinear samples of `ViewStack.packed`: one lookup instead of the four of `sample`."""
    Float, UInt, packed = stack.device.module.Float, stack.device.module.UInt, stack.packed
    corner, fx, fy = geometry.corner_of(stack, view, u, v, inside)
    Word = type(packed.values(view))
    word = dr.gather(Word, packed.values(view), corner)
    parts = [UInt((word >> (place * packed.bits)) & Word(2**packed.bits - 1)) for place in range(4)]
    value = geometry.bilinear([Float(part) for part in parts], fx, fy)
    value = dr.fma(value, constant(stack.device, packed.step), constant(stack.device, packed.low))
    return dr.select(inside & (parts[0] != MASKED), value, dr.nan)


def warp(values: list[Buffer], stack: ViewStack, rays, hypotheses: Hypotheses, neighbours: list[int]) -> None:
    """Fill ``values`` (`buffers`) with W of each neighbour; NaN outside its image."""
    start, step = hypotheses.start, hypotheses.step
    lines = [floats(stack.device, start), *rays]
    targets = [(view, room.array) for view, room in zip(neighbours, values, strict=True)]
    for part in geometry.segments(hypotheses.count):
        straddling = geometry.straddling_pixels(stack, start, step, part)
        if len(straddling) > _MANY * start.size:
            _warp_point_by_point(stack, lines, step, part, targets)
            continue
        _warp_along_curves(stack, lines, step, part, targets)
        if len(straddling):
            _warp_point_by_point(stack, lines, step, part, targets, straddling)


def _points(stack: ViewStack, lines: list, step: float, number) -> tuple:
    """Points at hypotheses (float), ``step`` [m] apart, of lines: lowest heights [m], and rays."""
    begin, *rays = lines
    points = geometry.point_at(rays, begin + number * constant(stack.device, step))
    dr.eval(points)
    return points


def _warp_along_curves(stack: ViewStack, lines: list, step: float, part: range, targets: list[tuple]) -> None:
    size = dr.width(lines[0])
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    per_step = constant(stack.device, 1.0 / max(len(part) - 1, 1))
    count, length, first = (dr.opaque(UInt, each) for each in (len(part), size, part.start * size))
    places = _curve_supports(stack, lines, step, part, [view for view, _ in targets])
    for group, of_group in zip(geometry.groups(targets), geometry.groups(places), strict=True):
        curves = [geometry.fit_curve(three) for three in of_group]

        def sample_views(number, at, group=group, curves=curves):
            for (view, target), curve in zip(group, curves, strict=True):
                seen = geometry.point_on_curve(curve, Float(number) * per_step, stack.camera_rows[view])
                dr.scatter(target, sample_packed(stack, view, *seen), at)
            return number + 1, at + length

        # Anew: values that a kernel has computed before would be arguments of another kernel.
        begin = dr.zeros(UInt, size), dr.arange(UInt, size) + first
        dr.while_loop(begin, lambda number, at: number < count, sample_views, labels=("number", "at"))
        dr.eval([target for _, target in group])


def _curve_supports(stack: ViewStack, lines: list, step: float, part: range, neighbours: list[int]) -> list:
    """Pixel positions (u, v) of the first, middle and last hypothesis in each neighbour."""
    found = []
    for number in np.linspace(part.start, part.stop - 1, 3):
        points, places = _points(stack, lines, step, constant(stack.device, number)), []
        for group in geometry.groups(neighbours):
            rows = [stack.camera_rows[view] for view in group]
            places += [geometry.project_in_front(row, points, stack.kernel_water, stack.terms) for row in rows]
            dr.eval(places)
        found.append(places)
    return list(zip(*found, strict=True))


def _warp_point_by_point(
    stack: ViewStack, lines: list, step: float, part: range, targets: list[tuple], pixels: np.ndarray | None = None
) -> None:
    """Warp with every point projected: all rays, or some by number (n,)."""
    size = dr.width(lines[0])
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    num = size if pixels is None else len(pixels)
    number, pixel = hypothesis_and_pixel(stack.device, num * len(part), num)
    if pixels is not None:
        pixel = dr.gather(UInt, indices(stack.device, pixels), pixel)
    number += dr.opaque(UInt, part.start)
    at = number * dr.opaque(UInt, size) + pixel
    dr.eval(at)
    points = _points(stack, [dr.gather(type(each), each, pixel) for each in lines], step, Float(number))
    for group in geometry.groups(targets):
        for view, target in group:
            seen = geometry.project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
            dr.scatter(target, sample_packed(stack, view, *seen), at)
        dr.eval([target for _, target in group])


@dataclass(frozen=True)
class WideWindows:
    """Images from which sums over wide windows are taken, by rows first."""

    device: Device
    # reference, values list of Buffer: of J * P each
    reference: Buffer
    values: list[Buffer]
    rows: list[Buffer]  # For the sums over rows, of as many each
    # width, radius: [px]
    width: int
    radius: int

    def sums(self, terms: Callable[[list[tuple[Any, Any]]], list], room: Buffer) -> list:
        """Sums over all windows of an image and the reference, traced and not computed yet.

        ``terms`` takes the pixels of a row of the window, of the image and the reference, to sums over the row.
        """
        side, total = 2 * self.radius + 1, room.size
        count = total - side + 1
        pixels = [
            tuple(_shifted(self.device, each, at, count) for each in (room, self.reference)) for at in range(side)
        ]
        index, rows = dr.arange(self.device.module.UInt, count), terms(pixels)
        for target, row in zip(self.rows, rows, strict=False):
            dr.scatter(target.array, row, index)
        dr.eval([target.array for target in self.rows[: len(rows)]])
        count -= (side - 1) * self.width
        sums: list[Any] = [0.0] * len(rows)
        for first in range(side):
            parts = [_shifted(self.device, each, first * self.width, count) for each in self.rows[: len(rows)]]
            sums = [column_sum + part for column_sum, part in zip(sums, parts, strict=True)]
        return sums


def buffers(device: Device, count: int, size: int) -> list[Buffer]:
    """Memory for W of so many neighbours, of J * P each; allocate it before `warp`."""
    return [Buffer.of(device, size) for _ in range(count)]


def reference_buffer(device: Device, size: int) -> Buffer:
    """Memory for the reference at each hypothesis, J * P; allocate it before `warp`."""
    return Buffer.of(device, size)


def _shifted(device: Device, room: Buffer, first: int, count: int):
    """Slice of an array: on the CPU a view of its memory, which kernels read in whole vectors."""
    if room.memory is not None:
        return device.module.Float(room.memory[first : first + count])
    UInt = device.module.UInt
    return dr.gather(type(room.array), room.array, dr.arange(UInt, count) + dr.opaque(UInt, first))


def prepare_windows(
    device: Device, reference, greys: Buffer, values: list[Buffer], width: int, radius: int
) -> list[list] | WideWindows:
    """Pixels of all windows of the reference and of W of each neighbour, one array per place in the window.

    Of wide ones the images alone. ``greys`` is the `reference_buffer`, which is filled from the ``reference`` (P);
    ``values`` are the `buffers` that `warp` has filled.
    """
    Float, total = device.module.Float, greys.size
    index = dr.arange(device.module.UInt, total)
    grey = dr.gather(Float, reference, hypothesis_and_pixel(device, total, dr.width(reference))[1])
    dr.scatter(greys.array, grey, index)
    dr.eval(greys.array)
    if radius > _WIDEST_AT_ONCE:
        return WideWindows(device, greys, values, buffers(device, _KNOWN_SUMS, total), width, radius)
    side = 2 * radius + 1
    offsets = [row * width + column for row in range(side) for column in range(side)]
    count = total - offsets[-1]
    return [[_shifted(device, room, o, count) for o in offsets] for room in (greys, *values)]


def ncc(windows: list[list] | WideWindows, radius: int, least_known: float = 1.0) -> list:
    """NCC of W (K arrays of J * P) with the reference over square windows; -1 where a window is incomplete.

    The windows run over the flattened strips, and the first and last M = radius * (width + 1) of them, which would
    begin before it or end after it, are left out: K arrays of J * P - 2 M, traced and not computed yet. Windows that
    wrap around a row's end, or leave the strip, are wrong: the caller discards the halo (`radius` pixels at every
    edge). With ``least_known`` below 1 the pixels that both have are compared, where these are such a share of the
    window.
    """
    side = 2 * radius + 1
    scale = 1.0 / side**2
    if isinstance(windows, WideWindows):
        return _ncc_of_wide(windows, scale, least_known)
    reference, *windows = windows
    if least_known < 1.0:
        return [_ncc_of_known(window, reference, least_known * side**2) for window in windows]
    m_i, v_i, _ = _moments(reference, reference, scale)
    v_i = dr.maximum(v_i, NOISE_VARIANCE)
    return [_score(_moments(window, reference, scale), m_i, v_i) for window in windows]


def _score(moments: tuple[Any, Any, Any], m_i, v_i):
    """NCC from mean and variance of a window, the mean of its products with the reference, and those of the latter."""
    mean, variance, product = moments
    score = (product - mean * m_i) * dr.rsqrt(dr.maximum(variance, NOISE_VARIANCE) * v_i)
    # An incomplete window is NaN; a complete one stays above -1, the mark of an incomplete one.
    return dr.select(dr.isnan(score), -1.0, dr.maximum(score, -0.999))


def _ncc_of_wide(windows: WideWindows, scale: float, least_known: float) -> list:
    """NCC of wide windows, one neighbour before the next, so that their sums over rows share memory; as `ncc`."""
    if least_known < 1.0:
        return [
            _evaluated(_score_of_known(windows.sums(_known_row, room), least_known / scale)) for room in windows.values
        ]
    m_i, v_i, _ = _central(windows.sums(_row, windows.reference), scale)
    v_i = dr.maximum(v_i, NOISE_VARIANCE)
    dr.eval(m_i, v_i)
    return [_evaluated(_score(_central(windows.sums(_row, room), scale), m_i, v_i)) for room in windows.values]


def _evaluated(array):
    dr.eval(array)
    return array


def _ncc_of_known(window: list, reference: list, least: float):
    """NCC of windows over the pixels that both have; -1 where these are fewer than ``least``."""
    return _score_of_known(_known_row(list(zip(window, reference, strict=True))), least)


def _known_row(pixels: list[tuple[Any, Any]]) -> list:
    """Over pixels of a window and the reference that are both known: their count, and sums of w, i, w^2, i^2, w i."""
    count: Any = 0.0
    sums: list[Any] = [0.0] * (_KNOWN_SUMS - 1)
    for w, i in pixels:
        known = ~(dr.isnan(w) | dr.isnan(i))
        w, i = dr.select(known, w, 0.0), dr.select(known, i, 0.0)
        count += dr.select(known, 1.0, 0.0)
        sums = [total + part for total, part in zip(sums, (w, i, w * w, i * i, w * i), strict=True)]
    return [count, *sums]


def _score_of_known(sums: list[Any], least: float):
    count, *sums = sums
    m_w, m_i, v_w, v_i, product = (each / dr.maximum(count, 1.0) for each in sums)
    v_w, v_i = (dr.maximum(v - m * m, NOISE_VARIANCE) for v, m in ((v_w, m_w), (v_i, m_i)))
    score = (product - m_w * m_i) * dr.rsqrt(v_w * v_i)
    return dr.select(count < least, -1.0, dr.maximum(score, -0.999))


def _row(pixels: list[tuple[Any, Any]]) -> list:
    """Sums of w, w^2 and w i over the pixels of a row of a window."""
    w, i = pixels[0]
    row = [w, w * w, w * i]
    for w, i in pixels[1:]:
        row = [row[0] + w, dr.fma(w, w, row[1]), dr.fma(w, i, row[2])]
    return row


def _central(sums: list[Any], scale: float) -> tuple[Any, Any, Any]:
    """Mean and variance from sums over a window, and the mean of the products."""
    mean = sums[0] * scale
    return mean, sums[1] * scale - mean * mean, sums[2] * scale


def _moments(window: list, others: list, scale: float) -> tuple[Any, Any, Any]:
    """Mean and variance over the pixels of a square window, and the mean of the products with those of another."""
    side = math.isqrt(len(window))
    sums: list[Any] = [0.0, 0.0, 0.0]
    for first in range(0, len(window), side):  # rows, then their sums: less rounding than in one long chain
        pixels = list(zip(window[first : first + side], others[first : first + side], strict=True))
        if first and first % (_ROWS_IN_REGISTERS * side) == 0:
            # A kernel computes the operands of a result one after the other: of three sums over a window each in turn,
            # with all pixels of the window in more registers than there are. So the value comes after the three.
            value, (a, b, c) = pixels[0][0], sums
            always = dr.opaque(dr.mask_t(value), True)
            pixels[0] = dr.select(always, value, dr.select(always, a, dr.select(always, b, c))), pixels[0][1]
        sums = [total + part for total, part in zip(sums, _row(pixels), strict=True)]
    return _central(sums, scale)


def best_half(device: Device, scores: list):
    """Mean over the better half of the K neighbours that have the window in their image; -1 where none has.

    The half is rounded up and at least two where two see the window, so that a place at the edge of the block is
    not judged by views that do not show it.
    """
    Float = device.module.Float
    keep = max((len(scores) + 1) // 2, min(2, len(scores)))
    top = [Float(-1.0)] * keep
    seen, total, used = Float(0.0), Float(0.0), Float(0.0)
    for score in scores:
        seen += dr.select(score > -1.0, 1.0, 0.0)
        for slot in range(keep):  # insertion into a short sorted list, largest first
            high = dr.maximum(top[slot], score)
            score = dr.minimum(top[slot], score)
            top[slot] = high
    num_averaged = dr.maximum(dr.ceil(0.5 * seen), dr.minimum(seen, 2.0))
    for slot in range(keep):
        take = float(slot) < num_averaged
        total += dr.select(take, top[slot], 0.0)
        used += dr.select(take, 1.0, 0.0)
    mean = dr.select(used > 0.0, total / dr.maximum(used, 1.0), -1.0)
    dr.eval(mean)
    return mean


def best_height(device: Device, mean, start, step: float, count: int):
    """Best height per pixel by a parabola through the best score and its two neighbours, its score and curvature.

    ``mean`` (J * P - 2 M) has lost M values at either end; so have the results, of P - 2 M. Returns ``height`` [m];
    ``score`` of the best hypothesis; ``curvature`` [1/m^2], minus the second derivative of the score; 0 where the best
    hypothesis is at an end.
    """
    Float, UInt = device.module.Float, device.module.UInt
    lost = dr.width(start) * count - dr.width(mean)
    P = dr.width(start) - lost
    pixel, size = dr.arange(UInt, P), dr.opaque(UInt, dr.width(start))
    start = dr.gather(Float, start, pixel + dr.opaque(UInt, lost // 2))
    best = dr.gather(Float, mean, pixel)
    at, low, high, before = dr.zeros(Float, P), Float(best), Float(best), Float(best)
    for j in range(1, count):
        place = dr.opaque(Float, float(j))
        score = dr.gather(Float, mean, pixel + size * dr.opaque(UInt, j))
        high = dr.select(at == place - 1.0, score, high)
        better = score > best
        best = dr.select(better, score, best)
        at = dr.select(better, place, at)
        low = dr.select(better, before, low)
        high = dr.select(better, score, high)
        before = score
        if j % HYPOTHESES_PER_KERNEL == 0:
            dr.eval(best, at, low, high, before)
    inner = (at > 0.5) & (at < dr.opaque(Float, count - 1.5))
    bend = 2.0 * best - low - high
    offset = dr.select(inner & (bend > 1e-6), dr.clip(0.5 * (high - low) / dr.maximum(bend, 1e-6), -0.5, 0.5), 0.0)
    step = dr.opaque(Float, float(step))
    height = start + (at + offset) * step
    curvature = dr.select(inner, dr.maximum(bend, 0.0) / (step * step), 0.0)
    dr.eval(height, best, curvature)
    return height, best, curvature
