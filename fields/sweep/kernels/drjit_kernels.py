"""Kernels in Dr.Jit: neighbour images warped along refracted rays.

One call takes a strip of rows of a reference view and the height hypotheses of each pixel. As these are offsets to a
*per-pixel* height, the window of each pixel follows the relief found so far.

    K neighbours, J hypotheses, P pixels of the strip (with a halo of the window's radius)
    W  neighbour intensity at (k, j, p): the bed point of pixel p at hypothesis j, seen by neighbour k

One kernel projects points into several neighbours, whose cameras are its arguments: all points of the hypotheses, which
are computed once, or, where the hypotheses lie on one side of the water, three of them, by which another kernel finds
the others (`fields.sweep.kernels.rays`). `drjit_scoring` scores the agreement of W with the reference. Callers get
these functions from `fields.sweep.matching.kernels`; `torch_kernels` has the same without Dr.Jit.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from fields.sweep.kernels import drjit_scoring as scoring
from fields.sweep.kernels.arrays import Buffer, constant, floats, hypothesis_and_pixel, indices
from fields.sweep.kernels.rays import (
    bilinear,
    corner_of,
    fit_curve,
    groups,
    in_front_of_camera,
    point_at,
    point_on_curve,
    project,
    project_with_depth,
    segments,
    straddling_pixels,
)
from fields.sweep.kernels.stack import MASKED, Hypotheses, ViewStack

# The rest of the kernels.
buffers, reference_buffer = scoring.buffers, scoring.reference_buffer
prepare_windows, ncc = scoring.prepare_windows, scoring.ncc
best_half, best_height = scoring.best_half, scoring.best_height
_MANY = 0.3  # Share of pixels that straddle the water from which on all points are projected


def sample_packed(stack: ViewStack, view: int, u, v, inside):
    """Bilinear samples of `ViewStack.packed`: one lookup instead of the four of `sample`."""
    Float, UInt, packed = stack.device.module.Float, stack.device.module.UInt, stack.packed
    corner, fx, fy = corner_of(stack, view, u, v, inside)
    Word = type(packed.values(view))
    word = dr.gather(Word, packed.values(view), corner)
    parts = [UInt((word >> (place * packed.bits)) & Word(2**packed.bits - 1)) for place in range(4)]
    value = bilinear([Float(part) for part in parts], fx, fy)
    value = dr.fma(value, constant(stack.device, packed.step), constant(stack.device, packed.low))
    return dr.select(inside & (parts[0] != MASKED), value, dr.nan)


def warp(values: list[Buffer], stack: ViewStack, rays, hypotheses: Hypotheses, neighbours: list[int]) -> None:
    """Fill ``values`` (`buffers`) with W of each neighbour; NaN outside its image."""
    start, step = hypotheses.start, hypotheses.step
    lines = [floats(stack.device, start), *rays]
    targets = [(view, room.array) for view, room in zip(neighbours, values, strict=True)]
    for part in segments(hypotheses.count):
        straddling = straddling_pixels(stack, start, step, part)
        if len(straddling) > _MANY * start.size:
            _warp_point_by_point(stack, lines, step, part, targets)
            continue
        _warp_along_curves(stack, lines, step, part, targets)
        if len(straddling):
            _warp_point_by_point(stack, lines, step, part, targets, straddling)


def _points(stack: ViewStack, lines: list, step: float, number) -> tuple:
    """Points at hypotheses (float), ``step`` [m] apart, of lines: lowest heights [m], and rays."""
    begin, *rays = lines
    points = point_at(rays, begin + number * constant(stack.device, step))
    dr.eval(points)
    return points


def _warp_along_curves(stack: ViewStack, lines: list, step: float, part: range, targets: list[tuple]) -> None:
    size = dr.width(lines[0])
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    per_step = constant(stack.device, 1.0 / max(len(part) - 1, 1))
    count, length, first = (dr.opaque(UInt, each) for each in (len(part), size, part.start * size))
    places = _curve_supports(stack, lines, step, part, [view for view, _ in targets])
    for group, of_group in zip(groups(targets), groups(places), strict=True):
        curves = [fit_curve(three) for three in of_group]

        def sample_views(number, at, group=group, curves=curves):
            for (view, target), curve in zip(group, curves, strict=True):
                seen = point_on_curve(curve, Float(number) * per_step, stack.camera_rows[view])
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
        for group in groups(neighbours):
            seen = [project_with_depth(stack.camera_rows[v], points, stack.kernel_water, stack.terms) for v in group]
            places += [in_front_of_camera(each) for each in seen]
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
    for group in groups(targets):
        for view, target in group:
            seen = project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
            dr.scatter(target, sample_packed(stack, view, *seen), at)
        dr.eval([target for _, target in group])
