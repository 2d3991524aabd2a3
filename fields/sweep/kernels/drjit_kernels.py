"""Images warped along bent paths, in Dr.Jit: the bed in the neighbours at every height that is tried.

One call takes a strip of rows of a reference view, a height per pixel and a ladder of steps about it. Because the rungs
are offsets to a *per-pixel* height, the window of each pixel follows the relief found so far.

    K neighbours, J rungs, P pixels of the strip (with a halo of the window's radius)
    W  neighbour intensity at (k, j, p): the bed point of pixel p at rung j, seen by neighbour k

One kernel projects points into several neighbours, whose cameras are its arguments: all points of the hypotheses, which
are computed once, or, where the hypotheses lie on one side of the water, three of them, by which another kernel finds
the others (`fields.sweep.kernels.rays`). `drjit_scoring` scores the agreement of W with the reference. Callers get
these functions from `fields.sweep.kernels.backend.kernels`; `torch_kernels` is the twin without Dr.Jit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from fields.sweep.kernels import drjit_scoring as scoring
from fields.sweep.kernels.arrays import Room, constant, floats, indices, rung_and_pixel
from fields.sweep.kernels.rays import (
    course_through,
    in_front,
    legs_through,
    place_at,
    place_on,
    point_at,
    sections,
    seen_at,
    through_water,
)
from fields.sweep.kernels.stack import MASKED, Beyond, Hypotheses, ViewStack, camera_table

# The rest of `fields.sweep.kernels.backend.Kernels`.
NOISE_VARIANCE = scoring.NOISE_VARIANCE
buffers, windows, ncc = scoring.buffers, scoring.windows, scoring.ncc
best_half, best_height = scoring.best_half, scoring.best_height
# Views that one kernel projects into: more take as long in several kernels, which compile faster and serve any number.
VIEWS_PER_KERNEL = 4
# Samples (neighbours x rungs x pixels) of one launch: 32 MB in all.
SAMPLES_PER_LAUNCH = 8_000_000
# Share of the pixels that is projected point by point from which all are.
_MANY = 0.3


def legs_of(stack: ViewStack, view: int, first_row: int, rows: int):
    """Rays (`fields.sweep.kernels.rays`) of a strip of pixels of `view`: six floats of P = rows * width, or more."""
    UInt = stack.device.module.UInt
    first = dr.opaque(UInt, first_row * stack.width)
    return _legs_through(stack, view, dr.arange(UInt, rows * stack.width) + first)


def legs_at(stack: ViewStack, view: int, pixels: np.ndarray):
    """Legs of chosen pixels (flat indices) of a view."""
    return _legs_through(stack, view, indices(stack.device, pixels))


def _legs_through(stack: ViewStack, view: int, index):
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    width = dr.opaque(UInt, stack.width)
    line = index // width
    u = Float(index - line * width) + 0.5
    v = Float(line) + 0.5
    cameras = [stack.cameras[view]]
    beyond = Beyond.of(cameras)
    camera = [constant(stack.device, c) for c in camera_table(cameras, beyond, stack.frame)[0]]
    legs = legs_through(camera, u, v, stack.n_water or 1.0, beyond)
    dr.eval(legs)
    return legs


def project_at(stack: ViewStack, legs, z, view: int):
    """Pixel position in `view`, and whether inside it, of each path at its height of `z`."""
    return seen_at(stack.numbers[view], point_at(legs, z), stack.n_water, stack.beyond)


def _corner(stack: ViewStack, u, v, inside):
    """Index within its image of the upper left of the four pixels about (u, v), and the way from there [px]."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    x, y = dr.select(inside, u - 0.5, 0.0), dr.select(inside, v - 0.5, 0.0)
    x0, y0 = UInt(x), UInt(y)
    return y0 * dr.opaque(UInt, stack.width) + x0, x - Float(x0), y - Float(y0)


def _between(corners, fx, fy):
    """Bilinear interpolation between four corners, row by row."""
    a, b, c, d = corners
    top, bottom = dr.fma(fx, b - a, a), dr.fma(fx, d - c, c)
    return dr.fma(fy, bottom - top, top)


def sample(stack: ViewStack, view: int, u, v, inside):
    """Bilinear lookup in image `view` at pixel position (u, v); NaN where not inside."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    corner, fx, fy = _corner(stack, u, v, inside)
    width = dr.opaque(UInt, stack.width)
    corners = [dr.gather(Float, stack.pixels[view], corner + offset) for offset in (0, 1, width, width + 1)]
    return dr.select(inside, _between(corners, fx, fy), dr.nan)


def look_up(stack: ViewStack, view: int, u, v, inside):
    """As `sample`, of `ViewStack.quads`: one lookup instead of four."""
    Float, UInt, quads = stack.device.module.Float, stack.device.module.UInt, stack.quads
    corner, fx, fy = _corner(stack, u, v, inside)
    Word = type(quads.values[view])
    word = dr.gather(Word, quads.values[view], corner)
    parts = [UInt((word >> (place * quads.bits)) & Word(2**quads.bits - 1)) for place in range(4)]
    value = _between([Float(part) for part in parts], fx, fy)
    value = dr.fma(value, constant(stack.device, quads.step), constant(stack.device, quads.low))
    return dr.select(inside & (parts[0] != MASKED), value, dr.nan)


@dataclass(frozen=True)
class _Ladders:
    """Legs of P paths, their first rungs [m], and the step [m] between rungs."""

    stack: ViewStack
    legs: list
    begin: Any
    step: float

    @property
    def size(self) -> int:
        """P."""
        return dr.width(self.begin)

    def points(self, rung, pixel) -> tuple:
        """Of rungs, by floats, of paths by their numbers."""
        z = dr.gather(self.stack.device.module.Float, self.begin, pixel) + rung * constant(self.stack.device, self.step)
        points = point_at([dr.gather(type(row), row, pixel) for row in self.legs], z)
        dr.eval(points)
        return points


def warp(values: list[Room], stack: ViewStack, legs, hypotheses: Hypotheses, neighbours: list[int]) -> None:
    """Fill ``values`` (`buffers`, of which there may be more) with W of each neighbour; NaN outside its image."""
    start, step = hypotheses.start, hypotheses.step
    ladders = _Ladders(stack, legs, floats(stack.device, start), step)
    arrays = [room.array for room in values[: len(neighbours)]]
    for part in sections(hypotheses.count):
        wet_and_dry = through_water(stack, start, step, part)
        if len(wet_and_dry) > _MANY * ladders.size:
            _point_by_point(ladders, part, neighbours, arrays)
            continue
        _along_courses(ladders, part, neighbours, arrays)
        if len(wet_and_dry):
            _point_by_point(ladders, part, neighbours, arrays, wet_and_dry)


def _along_courses(ladders: _Ladders, part: range, neighbours: list[int], values: list) -> None:
    stack, size = ladders.stack, ladders.size
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    per_rung = constant(stack.device, 1.0 / max(len(part) - 1, 1))
    count, length, first = (dr.opaque(UInt, each) for each in (len(part), size, part.start * size))
    begin = dr.zeros(UInt, size), dr.arange(UInt, size) + first
    places = _ends_and_middles(ladders, part, neighbours)
    for group, of_group, targets in zip(*map(_groups, (neighbours, places, values)), strict=True):
        courses = [course_through(three) for three in of_group]

        def look(rung, at, group=group, targets=targets, courses=courses):
            for view, course, target in zip(group, courses, targets, strict=True):
                seen = place_on(course, Float(rung) * per_rung, stack.numbers[view])
                dr.scatter(target, look_up(stack, view, *seen), at)
            return rung + 1, at + length

        dr.while_loop(begin, lambda rung, at: rung < count, look, labels=("rung", "at"))
        dr.eval(targets)


def _ends_and_middles(ladders: _Ladders, part: range, neighbours: list[int]) -> list:
    """Places (u, v) of the first, the middle and the last point of each ladder in each neighbour."""
    stack, size = ladders.stack, ladders.size
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    third, pixel = rung_and_pixel(stack.device, 3 * size, size)
    first, half = (constant(stack.device, each) for each in (part.start, 0.5 * (len(part) - 1)))
    points = ladders.points(first + Float(third) * half, pixel)
    found = []
    for group in _groups(neighbours):
        places = [in_front(place_at(stack.numbers[view], points, stack.n_water, stack.beyond)) for view in group]
        dr.eval(places)
        found += places
    # Not as views of their memory: to ask where that is waits for the kernels.
    runs = [dr.arange(UInt, size) + dr.opaque(UInt, k * size) for k in range(3)]
    return [[[dr.gather(Float, each, run) for each in place] for run in runs] for place in found]


def _point_by_point(
    ladders: _Ladders, part: range, neighbours: list[int], values: list, pixels: np.ndarray | None = None
) -> None:
    """Of all paths, or of some by number (n,)."""
    stack, size = ladders.stack, ladders.size
    UInt, Float = stack.device.module.UInt, stack.device.module.Float
    num = size if pixels is None else len(pixels)
    rung, pixel = rung_and_pixel(stack.device, num * len(part), num)
    if pixels is not None:
        pixel = dr.gather(UInt, indices(stack.device, pixels), pixel)
    rung += dr.opaque(UInt, part.start)
    at = rung * dr.opaque(UInt, size) + pixel
    dr.eval(at)
    points = ladders.points(Float(rung), pixel)
    for group, targets in zip(_groups(neighbours), _groups(values), strict=True):
        for view, target in zip(group, targets, strict=True):
            seen = seen_at(stack.numbers[view], points, stack.n_water, stack.beyond)
            dr.scatter(target, look_up(stack, view, *seen), at)
        dr.eval(targets)


def _groups(views: list) -> list[list]:
    """Views, or what belongs to them, in groups of `VIEWS_PER_KERNEL`; the last may have fewer."""
    return [views[first : first + VIEWS_PER_KERNEL] for first in range(0, len(views), VIEWS_PER_KERNEL)]


def compare(stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray | None = None):
    """Height maps compared: each pixel of `view`, or some (flat indices), is carried into its peers at its own height.

    Returns
    -------
    count, total, square : (P) each
        Of the differences [m] (the peer's height there, bilinear, less the own one) that are below `tolerance` [m].
    """
    Float = stack.device.module.Float
    if pixels is None:
        legs, own = legs_of(stack, view, 0, stack.height), stack.pixels[view]
    else:
        legs, own = paths_of(stack, view, pixels)
    count, total, square = (dr.opaque(Float, 0.0, dr.width(own)) for _ in range(3))
    for group in _groups(peers):
        for peer in group:
            difference = sample(stack, peer, *project_at(stack, legs, own, peer)) - own
            near = dr.abs(difference) < dr.opaque(Float, tolerance)
            difference = dr.select(near, difference, 0.0)
            count += dr.select(near, 1.0, 0.0)
            total += difference
            square += difference * difference
        dr.eval(count, total, square)
    return count, total, square


def looked_through(stack: ViewStack, view: int, peers: list[int], tolerance: float):
    """How many peers (P) see, through the point of each pixel of height map `view`, something that lies lower.

    All four of the peer's pixels about the point are lower by more than `tolerance` [m]; NaN sees nothing.
    """
    Float, UInt, size = stack.device.module.Float, stack.device.module.UInt, stack.width * stack.height
    legs = legs_of(stack, view, 0, stack.height)
    own = stack.pixels[view]
    count, least, width = dr.opaque(Float, 0.0, size), own - dr.opaque(Float, tolerance), dr.opaque(UInt, stack.width)
    for group in _groups(peers):
        for peer in group:
            u, v, lower = project_at(stack, legs, own, peer)
            corner, _, _ = _corner(stack, u, v, lower)
            for offset in (0, 1, width, width + 1):
                lower &= dr.gather(Float, stack.pixels[peer], corner + offset, lower) < least
            count += dr.select(lower, 1.0, 0.0)
        dr.eval(count)
    return count


def paths_of(stack: ViewStack, view: int, pixels: np.ndarray):
    """Legs (as `legs_of`) of chosen pixels (flat indices) of a view, and their heights in a stack of height maps."""
    legs = legs_at(stack, view, pixels)
    own = dr.gather(stack.device.module.Float, stack.pixels[view], indices(stack.device, pixels))
    dr.eval(own)
    return legs, own


def claim(stack: ViewStack, legs, own, later: int, tolerance: float, apart: float) -> tuple[np.ndarray, np.ndarray]:
    """The pixels (P) bool of height map `later` that show the bed of paths at their own heights, and those beside them.

    The first are the four pixels about the projection of each path, where their height is within `tolerance` [m]; the
    second those of them whose height is within `apart` [m] of the path's, or of that of the map between the four.
    """
    Float, UInt, Byte = stack.device.module.Float, stack.device.module.UInt, stack.device.module.UInt8
    claimed, beside = (dr.zeros(Byte, stack.width * stack.height) for _ in range(2))
    u, v, inside = project_at(stack, legs, own, later)
    corner, fx, fy = _corner(stack, u, v, inside)
    width, most = dr.opaque(UInt, stack.width), dr.opaque(Float, apart)
    offsets = (0, 1, width, width + 1)
    heights = [dr.gather(Float, stack.pixels[later], corner + offset, inside) for offset in offsets]
    between = _between(heights, fx, fy)
    for offset, there in zip(offsets, heights, strict=True):
        off = dr.abs(there - own)
        same = inside & (off < dr.opaque(Float, tolerance))
        dr.scatter(claimed, Byte(1), corner + offset, same)
        dr.scatter(beside, Byte(1), corner + offset, same & (dr.minimum(off, dr.abs(there - between)) < most))
    dr.eval(claimed, beside)
    return claimed.numpy().view(bool), beside.numpy().view(bool)


def looks_at(
    stack: ViewStack, points: tuple, view: int, apart: float, sure: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which points (P) height map `view` has among its four pixels about each, and which it looks through: bool each.

    It has those between the lowest and the highest of the four heights, or within `apart` [m] of them. It looks through
    those above all four by more, if these are all ``sure`` (pixels) bool. Points are in the frame of the water plane.
    """
    Float, UInt, Byte = stack.device.module.Float, stack.device.module.UInt, stack.device.module.UInt8
    u, v, inside = seen_at(stack.numbers[view], points, stack.n_water, stack.beyond)
    corner, _, _ = _corner(stack, u, v, inside)
    width, reach, known = dr.opaque(UInt, stack.width), dr.opaque(Float, apart), Byte(sure.ravel().view(np.uint8))
    four = [corner + offset for offset in (0, 1, width, width + 1)]
    heights = [dr.gather(Float, stack.pixels[view], each, inside) for each in four]
    low, high = (dr.minimum(heights[0], heights[1]), dr.maximum(heights[0], heights[1]))
    for each in heights[2:]:
        low, high = dr.minimum(low, each), dr.maximum(high, each)
    below = high + reach < points[2]
    shown, through = inside & ~below & (low - reach < points[2]), inside & below
    for each in four:
        through &= dr.gather(Byte, known, each, inside) > 0
    found = [dr.select(each, Byte(1), Byte(0)) for each in (shown, through)]
    dr.eval(found)
    return found[0].numpy().view(bool), found[1].numpy().view(bool)
