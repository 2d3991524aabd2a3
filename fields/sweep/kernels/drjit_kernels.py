"""Kernels in Dr.Jit: neighbour images warped along refracted rays, height maps compared.

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
from fields.sweep.kernels.rays import (
    fit_curve,
    in_front_of_camera,
    point_at,
    point_on_curve,
    project,
    project_with_depth,
    refracted_rays,
    segments,
    straddling_pixels,
)
from fields.sweep.kernels.stack import MASKED, CameraTerms, Hypotheses, ViewStack, camera_table

# The rest of `fields.sweep.kernels.backend.Kernels`.
NOISE_VARIANCE = scoring.NOISE_VARIANCE
buffers, reference_buffer = scoring.buffers, scoring.reference_buffer
prepare_windows, ncc = scoring.prepare_windows, scoring.ncc
best_half, best_height = scoring.best_half, scoring.best_height
# Views that one kernel projects into: several kernels take no longer, compile faster and serve any number.
VIEWS_PER_KERNEL = 4
# Samples (neighbours x hypotheses x pixels) of one launch: 32 MB in all.
SAMPLES_PER_LAUNCH = 8_000_000
# Share of pixels that straddle the water from which on all points are projected.
_MANY = 0.3


def rays_of_rows(stack: ViewStack, view: int, first_row: int, rows: int):
    """Rays (`fields.sweep.kernels.rays`) of a strip of pixels of `view`: six floats of P = rows * width, or more."""
    UInt = stack.device.module.UInt
    first = dr.opaque(UInt, first_row * stack.width_of(view))
    return _refracted_rays(stack, view, dr.arange(UInt, rows * stack.width_of(view)) + first)


def rays_of_pixels(stack: ViewStack, view: int, pixels: np.ndarray):
    """Rays of chosen pixels (flat indices) of a view."""
    return _refracted_rays(stack, view, indices(stack.device, pixels))


def _refracted_rays(stack: ViewStack, view: int, index):
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    width = dr.opaque(UInt, stack.width_of(view))
    line = index // width
    u = Float(index - line * width) + 0.5
    v = Float(line) + 0.5
    cameras = [stack.cameras[view]]
    terms = CameraTerms.of(cameras)
    camera = [constant(stack.device, c) for c in camera_table(cameras, terms, stack.kernel_water)[0]]
    rays = refracted_rays(camera, u, v, stack.kernel_water, terms)
    dr.eval(rays)
    return rays


def project_rays(stack: ViewStack, rays, z, view: int):
    """Pixel position in `view` of each ray at its height `z`, and whether inside the image."""
    return project(stack.camera_rows[view], point_at(rays, z), stack.kernel_water, stack.terms)


def _corner(stack: ViewStack, view: int, u, v, inside):
    """Flat index of the upper left of the four pixels about (u, v), and the offset from it [px]."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    x, y = dr.select(inside, u - 0.5, 0.0), dr.select(inside, v - 0.5, 0.0)
    x0, y0 = UInt(x), UInt(y)
    return y0 * dr.opaque(UInt, stack.width_of(view)) + x0, x - Float(x0), y - Float(y0)


def _bilinear(corners, fx, fy):
    """Bilinear interpolation between four corners, row by row."""
    a, b, c, d = corners
    top, bottom = dr.fma(fx, b - a, a), dr.fma(fx, d - c, c)
    return dr.fma(fy, bottom - top, top)


def sample(stack: ViewStack, view: int, u, v, inside):
    """Bilinear lookup in image `view` at pixel position (u, v); NaN where not inside."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    corner, fx, fy = _corner(stack, view, u, v, inside)
    width = dr.opaque(UInt, stack.width_of(view))
    corners = [dr.gather(Float, stack.pixels[view], corner + offset) for offset in (0, 1, width, width + 1)]
    return dr.select(inside, _bilinear(corners, fx, fy), dr.nan)


def sample_packed(stack: ViewStack, view: int, u, v, inside):
    """Bilinear samples of `ViewStack.packed`: one lookup instead of the four of `sample`."""
    Float, UInt, packed = stack.device.module.Float, stack.device.module.UInt, stack.packed
    corner, fx, fy = _corner(stack, view, u, v, inside)
    Word = type(packed.values[view])
    word = dr.gather(Word, packed.values[view], corner)
    parts = [UInt((word >> (place * packed.bits)) & Word(2**packed.bits - 1)) for place in range(4)]
    value = _bilinear([Float(part) for part in parts], fx, fy)
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

    def points(self, number, pixel) -> tuple:
        """Points at hypotheses (float) of rays, each by its number."""
        z = dr.gather(self.stack.device.module.Float, self.begin, pixel) + number * constant(
            self.stack.device, self.step
        )
        points = point_at([dr.gather(type(row), row, pixel) for row in self.rays], z)
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
    for group, of_group, targets in zip(*map(_groups, (neighbours, places, values)), strict=True):
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
    stack, size = ray_points.stack, ray_points.size
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    third, pixel = hypothesis_and_pixel(stack.device, 3 * size, size)
    first, half = (constant(stack.device, each) for each in (part.start, 0.5 * (len(part) - 1)))
    points = ray_points.points(first + Float(third) * half, pixel)
    found = []
    for group in _groups(neighbours):
        places = [
            in_front_of_camera(project_with_depth(stack.camera_rows[view], points, stack.kernel_water, stack.terms))
            for view in group
        ]
        dr.eval(places)
        found += places
    # Not as views of their memory: its address is known only after the kernels.
    runs = [dr.arange(UInt, size) + dr.opaque(UInt, k * size) for k in range(3)]
    return [[[dr.gather(Float, each, run) for each in place] for run in runs] for place in found]


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
    for group, targets in zip(_groups(neighbours), _groups(values), strict=True):
        for view, target in zip(group, targets, strict=True):
            seen = project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
            dr.scatter(target, sample_packed(stack, view, *seen), at)
        dr.eval(targets)


def _groups(views: list) -> list[list]:
    """Lists per view in groups of `VIEWS_PER_KERNEL`; the last may have fewer."""
    return [views[first : first + VIEWS_PER_KERNEL] for first in range(0, len(views), VIEWS_PER_KERNEL)]


def compare_heights(stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray | None = None):
    """Height differences to the peers: each pixel of `view`, or some (flat indices), projected at its own height.

    Returns
    -------
    count, total, square : (P) each
        Of the differences [m] (the peer's height there, bilinear, less the own one) that are below `tolerance` [m].
    """
    Float = stack.device.module.Float
    if pixels is None:
        rays, own_height = rays_of_rows(stack, view, 0, stack.height_of(view)), stack.pixels[view]
    else:
        rays, own_height = rays_and_heights(stack, view, pixels)
    count, total, square = (dr.opaque(Float, 0.0, dr.width(own_height)) for _ in range(3))
    for group in _groups(peers):
        for peer in group:
            difference = sample(stack, peer, *project_rays(stack, rays, own_height, peer)) - own_height
            near = dr.abs(difference) < dr.opaque(Float, tolerance)
            difference = dr.select(near, difference, 0.0)
            count += dr.select(near, 1.0, 0.0)
            total += difference
            square += difference * difference
        dr.eval(count, total, square)
    return count, total, square


def count_seeing_through(stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray):
    """Number of peers (P) that see through the points of pixels (flat indices) of height map `view` to something lower.

    All four of the peer's pixels about the point are lower by more than `tolerance` [m]; NaN sees nothing.
    """
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    rays, own_height = rays_and_heights(stack, view, pixels)
    count, least = dr.opaque(Float, 0.0, len(pixels)), own_height - dr.opaque(Float, tolerance)
    for group in _groups(peers):
        for peer in group:
            u, v, lower = project_rays(stack, rays, own_height, peer)
            corner, _, _ = _corner(stack, peer, u, v, lower)
            width = dr.opaque(UInt, stack.width_of(peer))
            for offset in (0, 1, width, width + 1):
                lower &= dr.gather(Float, stack.pixels[peer], corner + offset, lower) < least
            count += dr.select(lower, 1.0, 0.0)
        dr.eval(count)
    return count


def rays_and_heights(stack: ViewStack, view: int, pixels: np.ndarray):
    """Rays of chosen pixels (flat indices) of a view, and their heights in a stack of height maps."""
    rays = rays_of_pixels(stack, view, pixels)
    own_height = dr.gather(stack.device.module.Float, stack.pixels[view], indices(stack.device, pixels))
    dr.eval(own_height)
    return rays, own_height


def find_duplicates(
    stack: ViewStack, rays, own_height, other: int, tolerance: float, close_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P) bool of height map `other` that show the points of rays at their heights, and those close to them.

    The first are the four pixels about the projection of each path, where their height is within `tolerance` [m]; the
    second those of them whose height is within `close_m` of the path's, or of that of the map between the four.
    """
    Float, UInt, Byte = stack.device.module.Float, stack.device.module.UInt, stack.device.module.UInt8
    claimed, close = (dr.zeros(Byte, stack.width_of(other) * stack.height_of(other)) for _ in range(2))
    u, v, inside = project_rays(stack, rays, own_height, other)
    corner, fx, fy = _corner(stack, other, u, v, inside)
    width, most = dr.opaque(UInt, stack.width_of(other)), dr.opaque(Float, close_m)
    offsets = (0, 1, width, width + 1)
    heights = [dr.gather(Float, stack.pixels[other], corner + offset, inside) for offset in offsets]
    interpolated = _bilinear(heights, fx, fy)
    for offset, neighbour_height in zip(offsets, heights, strict=True):
        off = dr.abs(neighbour_height - own_height)
        same = inside & (off < dr.opaque(Float, tolerance))
        dr.scatter(claimed, Byte(1), corner + offset, same)
        dr.scatter(
            close, Byte(1), corner + offset, same & (dr.minimum(off, dr.abs(neighbour_height - interpolated)) < most)
        )
    dr.eval(claimed, close)
    return claimed.numpy().view(bool), close.numpy().view(bool)


def vote_on_points(
    stack: ViewStack, points: tuple, view: int, close_m: float, trusted: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Votes of height map `view` on points (P): bool where it spans, sees through, and matches them.

    A map spans points between the lowest and the highest of its four heights about them, or within `close_m` of these.
    It sees through those above all four by more, if these are all ``trusted`` (pixels) bool. It matches those within
    `close_m` of one of the four that is trusted: beside a step the others are between two surfaces. Points are in the
    frame of the water plane.
    """
    Float, UInt, Byte = stack.device.module.Float, stack.device.module.UInt, stack.device.module.UInt8
    u, v, inside = project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
    corner, _, _ = _corner(stack, view, u, v, inside)
    width, reach, known = (
        dr.opaque(UInt, stack.width_of(view)),
        dr.opaque(Float, close_m),
        Byte(trusted.ravel().view(np.uint8)),
    )
    four = [corner + offset for offset in (0, 1, width, width + 1)]
    heights = [dr.gather(Float, stack.pixels[view], each, inside) for each in four]
    low, high = (dr.minimum(heights[0], heights[1]), dr.maximum(heights[0], heights[1]))
    for each in heights[2:]:
        low, high = dr.minimum(low, each), dr.maximum(high, each)
    below = high + reach < points[2]
    spans, through, matches = inside & ~below & (low - reach < points[2]), inside & below, inside & False
    for each, height in zip(four, heights, strict=True):
        is_trusted = dr.gather(Byte, known, each, inside) > 0
        through &= is_trusted
        matches |= is_trusted & (dr.abs(height - points[2]) < reach)
    found = [dr.select(each, Byte(1), Byte(0)) for each in (spans, through, matches & inside)]
    dr.eval(found)
    spans, through, matches = (each.numpy().view(bool) for each in found)
    return spans, through, matches
