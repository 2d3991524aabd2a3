"""Kernels in Dr.Jit: neighbour images warped along refracted rays.

One call takes a strip of rows of a reference view and the height hypotheses of each pixel. As these are offsets to a
*per-pixel* height, the window of each pixel follows the relief found so far.

    K neighbours, J hypotheses, P pixels of the strip (with a halo of the window's radius)
    W  neighbour intensity at (k, j, p): the bed point of pixel p at hypothesis j, seen by neighbour k

One kernel projects points into several neighbours, whose cameras are its arguments: all points of the hypotheses, which
are computed once, or, where the hypotheses lie on one side of the water, three of them, by which another kernel finds
the others (`fields.sweep.kernels.rays`). `drjit_scoring` scores the agreement of W with the reference. Callers get
these functions from `fields.sweep.kernels.backend.kernels`; `torch_kernels` has the same without Dr.Jit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from fields.sweep.kernels import drjit_scoring as scoring
from fields.sweep.kernels.arrays import Buffer, constant, floats, hypothesis_and_pixel, indices
from fields.sweep.kernels.lookups import bilinear, corner_of, groups
from fields.sweep.kernels.rays import (
    fit_curve,
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
# Share of pixels that straddle the water from which on all points are projected.
_MANY = 0.3


def sample_packed(stack: ViewStack, view: int, u, v, inside):
    """Bilinear samples of `ViewStack.packed`: one lookup instead of the four of `sample`."""
    Float, UInt, packed = stack.device.module.Float, stack.device.module.UInt, stack.packed
    corner, fx, fy = corner_of(stack, view, u, v, inside)
    Word = type(packed.values[view])
    word = dr.gather(Word, packed.values[view], corner)
    parts = [UInt((word >> (place * packed.bits)) & Word(2**packed.bits - 1)) for place in range(4)]
    value = bilinear([Float(part) for part in parts], fx, fy)
    value = dr.fma(value, constant(stack.device, packed.step), constant(stack.device, packed.low))
    return dr.select(inside & (parts[0] != MASKED), value, dr.nan)


@dataclass(frozen=True)
class _RayPoints:
    """Points of P rays at height hypotheses: lowest ones ``begin`` [m], ``step`` [m]."""

    stack: ViewStack
    rays: list
    begin: Any
    step: float

    @property
    def size(self) -> int:
        """P."""
        return dr.width(self.begin)

    def points(self, number, pixel=None) -> tuple:
        """Points at hypotheses (float) of all rays, or of some by number."""
        begin, *rays = (
            each if pixel is None else dr.gather(type(each), each, pixel) for each in (self.begin, *self.rays)
        )
        points = point_at(rays, begin + number * constant(self.stack.device, self.step))
        dr.eval(points)
        return points


def warp(values: list[Buffer], stack: ViewStack, rays, hypotheses: Hypotheses, neighbours: list[int]) -> None:
    """Fill ``values`` (`buffers`) with W of each neighbour; NaN outside its image."""
    start, step = hypotheses.start, hypotheses.step
    ray_points = _RayPoints(stack, rays, floats(stack.device, start), step)
    arrays = [room.array for room in values]
    for part in segments(hypotheses.count):
        straddling = straddling_pixels(stack, start, step, part)
        if len(straddling) > _MANY * ray_points.size:
            _warp_point_by_point(ray_points, part, neighbours, arrays)
            continue
        _warp_along_curves(ray_points, part, neighbours, arrays)
        if len(straddling):
            _warp_point_by_point(ray_points, part, neighbours, arrays, straddling)


def _warp_along_curves(ray_points: _RayPoints, part: range, neighbours: list[int], values: list) -> None:
    stack, size = ray_points.stack, ray_points.size
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    per_step = constant(stack.device, 1.0 / max(len(part) - 1, 1))
    count, length, first = (dr.opaque(UInt, each) for each in (len(part), size, part.start * size))
    begin = dr.zeros(UInt, size), dr.arange(UInt, size) + first
    places = _curve_supports(ray_points, part, neighbours)
    for group, of_group, targets in zip(*map(groups, (neighbours, places, values)), strict=True):
        curves = [fit_curve(three) for three in of_group]

        def sample_views(number, at, group=group, targets=targets, curves=curves):
            for view, curve, target in zip(group, curves, targets, strict=True):
                seen = point_on_curve(curve, Float(number) * per_step, stack.camera_rows[view])
                dr.scatter(target, sample_packed(stack, view, *seen), at)
            return number + 1, at + length

        dr.while_loop(begin, lambda number, at: number < count, sample_views, labels=("number", "at"))
        dr.eval(targets)


def _curve_supports(ray_points: _RayPoints, part: range, neighbours: list[int]) -> list:
    """Pixel positions (u, v) of the first, middle and last hypothesis in each neighbour."""
    stack = ray_points.stack
    found: list[list] = [[] for _ in neighbours]
    for number in np.linspace(part.start, part.stop - 1, 3):
        points = ray_points.points(constant(stack.device, number))
        for group, of_group in zip(groups(neighbours), groups(found), strict=True):
            places = [
                in_front_of_camera(project_with_depth(stack.camera_rows[view], points, stack.kernel_water, stack.terms))
                for view in group
            ]
            dr.eval(places)
            for of_view, place in zip(of_group, places, strict=True):
                of_view.append(place)
    return found


def _warp_point_by_point(
    ray_points: _RayPoints, part: range, neighbours: list[int], values: list, pixels: np.ndarray | None = None
) -> None:
    """Warp with every point projected: all rays, or some by number (n,)."""
    stack, size = ray_points.stack, ray_points.size
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    num = size if pixels is None else len(pixels)
    number, pixel = hypothesis_and_pixel(stack.device, num * len(part), num)
    if pixels is not None:
        pixel = dr.gather(UInt, indices(stack.device, pixels), pixel)
    number += dr.opaque(UInt, part.start)
    at = number * dr.opaque(UInt, size) + pixel
    dr.eval(at)
    points = ray_points.points(Float(number), pixel)
    for group, targets in zip(groups(neighbours), groups(values), strict=True):
        for view, target in zip(group, targets, strict=True):
            seen = project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
            dr.scatter(target, sample_packed(stack, view, *seen), at)
        dr.eval(targets)
