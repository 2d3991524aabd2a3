"""Images warped along bent paths, in Dr.Jit: the bed in the neighbours at every height that is tried.

One call takes a strip of rows of a reference view, a height per pixel and a ladder of steps about it. Because the rungs
are offsets to a *per-pixel* height, the window of each pixel follows the relief found so far.

    K neighbours, J rungs, P pixels of the strip (with a halo of the window's radius)
    W  neighbour intensity at (k, j, p): the bed point of pixel p at rung j, seen by neighbour k

`fields.sweep.scoring_drjit` scores the agreement of W with the reference. Callers get these functions from
`fields.sweep.backends.warping`; `fields.sweep.warping_torch` is the twin without Dr.Jit.
"""

from __future__ import annotations

import drjit as dr
import numpy as np

from fields.sweep.arrays import indices
from fields.sweep.legs import legs_through, seen_at
from fields.sweep.stack import Beyond, ViewStack, camera_table

# Samples (neighbours x rungs x pixels) of one launch: 64 MB an array, large against a launch's cost.
STRIP_SAMPLES = 16_000_000


def pixels_of(stack: ViewStack, view: int, first_row: int, rows: int):
    """A strip of rows of the image of `view`: P = rows * width values."""
    UInt = stack.device.module.UInt
    first = dr.opaque(UInt, (view * stack.height + first_row) * stack.width)
    values = dr.gather(type(stack.pixels), stack.pixels, dr.arange(UInt, rows * stack.width) + first)
    dr.eval(values)
    return values


def legs_of(stack: ViewStack, view: int, first_row: int, rows: int):
    """Legs (see `fields.sweep.legs`) of a strip of pixels of `view`: nine floats of P = rows * width."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    width = dr.opaque(UInt, stack.width)
    index = dr.arange(UInt, rows * stack.width)
    line = index // width
    u = Float(index - line * width) + 0.5
    v = Float(line + dr.opaque(UInt, first_row)) + 0.5
    cameras = [stack.cameras[view]]
    beyond = Beyond.of(cameras)
    camera = [dr.opaque(Float, float(c)) for c in camera_table(cameras, beyond)[0]]
    legs = legs_through(camera, u, v, _water_plane(stack), beyond)
    dr.eval(legs)
    return legs


def _water_plane(stack: ViewStack):
    """`ViewStack.plane` with point and normal as opaque Dr.Jit floats."""
    Float = stack.device.module.Float
    point, normal, n_water = stack.plane
    return tuple(dr.opaque(Float, v) for v in point), tuple(dr.opaque(Float, v) for v in normal), n_water


def project_at(stack: ViewStack, legs, z, pixel, view):
    """Pixel position in `view`, and whether inside it, of the path of `pixel` at height `z` (all Dr.Jit)."""
    Float = stack.device.module.Float
    own = [dr.gather(Float, row, pixel) for row in legs]
    camera = [dr.gather(Float, stack.table, view * stack.beyond.row + c) for c in range(stack.beyond.row)]
    return seen_at(camera, own, z, None if stack.water is None else _water_plane(stack), stack.beyond)


def sample(stack: ViewStack, view, u, v, inside):
    """Bilinear lookup in image `view` at pixel position (u, v); NaN where not inside."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    x = dr.select(inside, u - 0.5, 0.0)
    y = dr.select(inside, v - 0.5, 0.0)
    x0, y0 = UInt(x), UInt(y)
    fx, fy = x - Float(x0), y - Float(y0)
    width, area = dr.opaque(UInt, stack.width), dr.opaque(UInt, stack.width * stack.height)
    base = view * area + y0 * width + x0

    def at(offset):
        return dr.gather(Float, stack.pixels, base + offset, inside)

    top = dr.fma(fx, at(1) - at(0), at(0))
    bottom = dr.fma(fx, at(width + 1) - at(width), at(width))
    return dr.select(inside, dr.fma(fy, bottom - top, top), dr.nan)


def warp(stack: ViewStack, legs, start, neighbours, step, rungs: int):
    """Neighbour intensities W at (k, j, p), a Dr.Jit float of K * J * P; NaN outside the neighbour's image."""
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    P, K = dr.width(start), dr.width(neighbours)
    strip, ladder = dr.opaque(UInt, P), dr.opaque(UInt, P * rungs)
    index = dr.arange(UInt, P * rungs * K)
    k = index // ladder
    rest = index - k * ladder
    j = rest // strip
    pixel = rest - j * strip
    z = dr.gather(Float, start, pixel) + Float(j) * dr.opaque(Float, float(step))
    view = dr.gather(UInt, neighbours, k)
    u, v, inside = project_at(stack, legs, z, pixel, view)
    values = sample(stack, view, u, v, inside)
    dr.eval(values)
    return values


def compare(stack: ViewStack, view: int, peers: list[int], tolerance: float):
    """Height maps compared: each pixel of `view` is carried into its peers at its own height.

    Returns
    -------
    count, total, square : (P) each
        Of the differences [m] (the peer's height there, bilinear, less the own one) that are below `tolerance` [m].
    """
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    size = stack.width * stack.height
    legs = legs_of(stack, view, 0, stack.height)
    own, pixel = pixels_of(stack, view, 0, stack.height), dr.arange(UInt, size)
    count, total, square = dr.zeros(Float, size), dr.zeros(Float, size), dr.zeros(Float, size)
    for peer in peers:
        which = dr.opaque(UInt, peer)
        u, v, inside = project_at(stack, legs, own, pixel, which)
        difference = sample(stack, which, u, v, inside) - own
        near = dr.abs(difference) < dr.opaque(Float, tolerance)
        difference = dr.select(near, difference, 0.0)
        count += dr.select(near, 1.0, 0.0)
        total += difference
        square += difference * difference
        dr.eval(count, total, square)
    return count, total, square


def paths_of(stack: ViewStack, view: int, pixels: np.ndarray):
    """Legs (as `legs_of`) of chosen pixels (flat indices) of a view, and their heights in a stack of height maps."""
    chosen = indices(stack.device, pixels)
    legs = [dr.gather(type(row), row, chosen) for row in legs_of(stack, view, 0, stack.height)]
    own = dr.gather(type(stack.pixels), pixels_of(stack, view, 0, stack.height), chosen)
    dr.eval(legs, own)
    return legs, own


def claim(stack: ViewStack, legs, own, later: int, tolerance: float, claimed) -> None:
    """Set to 1, in `claimed` (P), the pixels of height map `later` that show the bed of paths at their own heights.

    These are the four pixels about the projection of each path, where their height is within `tolerance` [m].
    """
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    u, v, inside = project_at(stack, legs, own, dr.arange(UInt, dr.width(own)), dr.opaque(UInt, later))
    x0, y0 = UInt(dr.select(inside, u - 0.5, 0.0)), UInt(dr.select(inside, v - 0.5, 0.0))
    width = dr.opaque(UInt, stack.width)
    corner = y0 * width + x0
    base = dr.opaque(UInt, later * stack.width * stack.height)
    for offset in (0, 1, width, width + 1):
        there = dr.gather(Float, stack.pixels, base + corner + offset, inside)
        same = inside & (dr.abs(there - own) < dr.opaque(Float, tolerance))
        dr.scatter(claimed, UInt(1), corner + offset, same)
    dr.eval(claimed)
