"""How well neighbours agree with a reference along a ladder of heights, and the best height, in Dr.Jit.

    K neighbours, J rungs, P pixels of a strip of rows (with a halo of the window's radius)
    NCC    of the warped intensities W (k, j, p) and the reference (p) over a square window
    score  mean of the best half of the neighbours' NCC, per (j, p): an occluded neighbour scores low and drops out

Callers get these functions from `fields.sweep.backends.scoring`; `fields.sweep.scoring_torch` is the twin.
"""

from __future__ import annotations

import drjit as dr

from fields.device import Device

# A window flatter than this (grey levels squared, at 8 bits) holds noise, not texture; it lowers NCC there.
NOISE_VARIANCE = 1.0
# A ladder is climbed in kernels of this many rungs: one of hundreds, in one kernel, takes minutes to compile.
RUNGS_PER_KERNEL = 8


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
