"""Photo-consistency along bent rays: the inner loop of the plane sweep, in Dr.Jit.

One call takes a strip of rows of a reference view, a height per pixel and a ladder of steps about it, and
says for each rung how well the neighbours agree with the reference there. Because the rungs are offsets to
a *per-pixel* height, the window of each pixel follows the relief found so far.

    K neighbours, J rungs, P pixels of the strip (with a halo of the window's radius)
    W     neighbour intensity at (k, j, p): the bed point of pixel p at rung j, seen by neighbour k
    NCC   of W and the reference over a square window, per (k, j, p)
    score mean of the best half of the neighbours' NCC, per (j, p): an occluded neighbour scores low and drops out

Callers take these functions from `Device.kernels`; `fields.sweep.matching_torch` has the same without Dr.Jit.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from fields.device import Device
from fields.sweep.stack import CAMERA_ROW, ViewStack, camera_table
from refract import kernels

# One step leaves 0.015 px at worst in drone geometry, from 5 m over 15 m of water, and 4e-4 px rms (docs/optics.md).
CROSSING_STEPS = 1
# A window flatter than this (grey levels squared, at 8 bits) holds noise, not texture; it lowers NCC there.
NOISE_VARIANCE = 1.0
# Samples (neighbours x rungs x pixels) of one launch: 64 MB an array, large against a launch's cost.
STRIP_SAMPLES = 16_000_000
# A ladder is climbed in kernels of this many rungs: one of hundreds, in one kernel, takes minutes to compile.
RUNGS_PER_KERNEL = 8


def floats(device: Device, array: np.ndarray):
    """An array of any shape as one flat Dr.Jit float."""
    return device.module.Float(np.ascontiguousarray(array, dtype=np.float32).ravel())


def indices(device: Device, array) -> Any:
    """Whole numbers from zero as one flat Dr.Jit unsigned int."""
    return device.module.UInt(np.ascontiguousarray(array, dtype=np.uint32).ravel())


def host(array) -> np.ndarray:
    """A Dr.Jit array as numpy, flat."""
    return array.numpy()


def release() -> None:
    """Give memory that is no longer used back to the system."""
    dr.flush_malloc_cache()


def pixels_of(stack: ViewStack, view: int, first_row: int, rows: int):
    """A strip of rows of the image of `view`: P = rows * width values."""
    UInt = stack.device.module.UInt
    first = dr.opaque(UInt, (view * stack.height + first_row) * stack.width)
    values = dr.gather(type(stack.pixels), stack.pixels, dr.arange(UInt, rows * stack.width) + first)
    dr.eval(values)
    return values


def legs_of(stack: ViewStack, view: int, first_row: int, rows: int):
    """Where the paths of a strip of pixels of `view` stand at a height z over the water plane: ``foot + z * slope``.

    Returns nine Dr.Jit floats of P = rows * width: the foot on the plane (3), the slope of the air leg (3) and of
    the water leg (3) per metre of height, local frame. For a dry survey the plane is local z = 0 and both slopes
    agree. A ray that does not fall toward the plane never meets the bed: NaN, which drops out of every score.
    """
    Float, UInt = stack.device.module.Float, stack.device.module.UInt
    width = dr.opaque(UInt, stack.width)
    index = dr.arange(UInt, rows * stack.width)
    line = index // width
    u = Float(index - line * width) + 0.5
    v = Float(line + dr.opaque(UInt, first_row)) + 0.5
    cam = [dr.opaque(Float, float(c)) for c in camera_table([stack.cameras[view]])[0]]
    x, y = (u - cam[14]) / cam[12], (v - cam[15]) / cam[13]
    ray = [cam[c] * x + cam[3 + c] * y + cam[6 + c] for c in range(3)]
    length = dr.rsqrt(kernels.dot(ray, ray))
    ray = tuple(c * length for c in ray)
    plane, normal, n_water = _water_plane(stack)
    fall = kernels.dot(ray, normal)
    fall = dr.select(fall < -1e-3, fall, dr.nan)
    height = kernels.dot(tuple(c - p for c, p in zip(cam[9:12], plane, strict=True)), normal)
    foot = kernels.along(cam[9:12], ray, -height / fall)
    bent = kernels.bend(ray, normal, 1.0, n_water)
    fall_wet = kernels.dot(bent, normal)
    legs = [*foot, *(c / fall for c in ray), *(c / fall_wet for c in bent)]
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
    leg = [dr.gather(Float, row, pixel) for row in legs]
    above = z > 0.0
    point = tuple(leg[c] + z * dr.select(above, leg[3 + c], leg[6 + c]) for c in range(3))
    cam = [dr.gather(Float, stack.table, view * CAMERA_ROW + c) for c in range(CAMERA_ROW)]
    centre = (cam[9], cam[10], cam[11])
    if stack.water is not None:
        point, _ = kernels.crossing_of_point(centre, point, *_water_plane(stack), CROSSING_STEPS)
    d = tuple(p - c for p, c in zip(point, centre, strict=True))
    x, y, depth = kernels.dot(cam[0:3], d), kernels.dot(cam[3:6], d), kernels.dot(cam[6:9], d)
    u = cam[12] * x / depth + cam[14]
    v = cam[13] * y / depth + cam[15]
    inside = (u >= 0.5) & (v >= 0.5) & (u < cam[16] - 0.5) & (v < cam[17] - 0.5) & (depth > 0.0)
    return u, v, inside


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


def _window_sums(device: Device, arrays, products, radius: int, width: int, stride: int):
    """Sums over a row of 2 radius + 1 samples of each product of the gathered arrays, at every index."""
    UInt = device.module.UInt
    total = dr.width(arrays[0])
    index = dr.arange(UInt, total)
    sums = None
    for offset in range(-radius, radius + 1):
        where = dr.opaque(device.module.Int, offset * stride) + device.module.Int(index)
        where = UInt(dr.clip(where, 0, dr.opaque(device.module.Int, total - 1)))
        terms = products(where)
        sums = terms if sums is None else [s + t for s, t in zip(sums, terms, strict=True)]
    return sums


def ncc(device: Device, reference, values, width: int, radius: int):
    """NCC of W (K * J * P) with the reference strip (P) over square windows; -1 where a window is incomplete.

    The sums run over the flattened strip; windows that wrap around a row's end, or leave the strip, are wrong:
    the caller discards the halo (`radius` pixels at every edge).
    """
    Float, UInt = device.module.Float, device.module.UInt
    P = dr.opaque(UInt, dr.width(reference))
    mean_i, var_i = _reference_moments(device, reference, width, radius)

    def products(where):
        w = dr.gather(Float, values, where)
        i = dr.gather(Float, reference, where % P)
        return [w, w * w, w * i]

    rows = _window_sums(device, [values], products, radius, width, 1)
    dr.eval(rows)
    sums = _window_sums(device, rows, lambda where: [dr.gather(Float, r, where) for r in rows], radius, width, width)
    scale = 1.0 / (2 * radius + 1) ** 2
    pixel = dr.arange(UInt, dr.width(values)) % P
    m_i, v_i = dr.gather(Float, mean_i, pixel), dr.gather(Float, var_i, pixel)
    mean = sums[0] * scale
    variance = dr.maximum(sums[1] * scale - mean * mean, NOISE_VARIANCE)
    score = (sums[2] * scale - mean * m_i) * dr.rsqrt(variance * dr.maximum(v_i, NOISE_VARIANCE))
    # An incomplete window is NaN; a complete one stays above -1, the mark of an incomplete one.
    score = dr.select(dr.isnan(score), -1.0, dr.maximum(score, -0.999))
    dr.eval(score)
    return score


def _reference_moments(device: Device, reference, width: int, radius: int):
    Float = device.module.Float

    def products(where):
        i = dr.gather(Float, reference, where)
        return [i, i * i]

    rows = _window_sums(device, [reference], products, radius, width, 1)
    dr.eval(rows)
    sums = _window_sums(device, rows, lambda where: [dr.gather(Float, r, where) for r in rows], radius, width, width)
    scale = 1.0 / (2 * radius + 1) ** 2
    mean = sums[0] * scale
    variance = sums[1] * scale - mean * mean
    dr.eval(mean, variance)
    return mean, variance


def best_half(device: Device, score, neighbours: int):
    """Mean over the better half of the neighbours that have the window in their image, (J * P); -1 where none has.

    The half is rounded up and at least two where two see the window, so that a place at the edge of the block is
    not judged by views that do not show it.
    """
    Float, UInt = device.module.Float, device.module.UInt
    plane = dr.width(score) // neighbours
    index = dr.arange(UInt, plane)
    size = dr.opaque(UInt, plane)
    keep = max((neighbours + 1) // 2, min(2, neighbours))
    top = [Float(-1.0)] * keep
    seen = dr.zeros(Float, plane)
    for k in range(neighbours):
        s = dr.gather(Float, score, index + size * k)
        seen += dr.select(s > -1.0, 1.0, 0.0)
        for slot in range(keep):  # insertion into a short sorted list, largest first
            high = dr.maximum(top[slot], s)
            s = dr.minimum(top[slot], s)
            top[slot] = high
    wanted = dr.maximum(dr.ceil(0.5 * seen), dr.minimum(seen, 2.0))
    total, used = dr.zeros(Float, plane), dr.zeros(Float, plane)
    for slot in range(keep):
        take = float(slot) < wanted
        total += dr.select(take, top[slot], 0.0)
        used += dr.select(take, 1.0, 0.0)
    mean = dr.select(used > 0.0, total / dr.maximum(used, 1.0), -1.0)
    dr.eval(mean)
    return mean


def climb(device: Device, mean, start, step, rungs: int):
    """Best height per pixel with a parabola through its neighbours on the ladder, its score and its sharpness.

    Returns
    -------
    height : (P) [m]
    score : (P) of the best rung
    curvature : (P) [1/m^2], minus the second derivative of the score; 0 where the best rung is at an end
    """
    Float, UInt = device.module.Float, device.module.UInt
    P = dr.width(start)
    pixel, size = dr.arange(UInt, P), dr.opaque(UInt, P)
    best = dr.gather(Float, mean, pixel)
    at, low, high, before = dr.zeros(Float, P), Float(best), Float(best), Float(best)
    for j in range(1, rungs):
        place = dr.opaque(Float, float(j))
        score = dr.gather(Float, mean, pixel + size * dr.opaque(UInt, j))
        high = dr.select(at == place - 1.0, score, high)
        better = score > best
        best = dr.select(better, score, best)
        at = dr.select(better, place, at)
        low = dr.select(better, before, low)
        high = dr.select(better, score, high)
        before = score
        if j % RUNGS_PER_KERNEL == 0:
            dr.eval(best, at, low, high, before)
    inner = (at > 0.5) & (at < dr.opaque(Float, rungs - 1.5))
    bend = 2.0 * best - low - high
    offset = dr.select(inner & (bend > 1e-6), dr.clip(0.5 * (high - low) / dr.maximum(bend, 1e-6), -0.5, 0.5), 0.0)
    step = dr.opaque(Float, float(step))
    height = start + (at + offset) * step
    curvature = dr.select(inner, dr.maximum(bend, 0.0) / (step * step), 0.0)
    dr.eval(height, best, curvature)
    return height, best, curvature


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
