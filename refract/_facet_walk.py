"""Rays over plane triangles: a walk from triangle to triangle under the ray to where it first meets one.

All in numpy float64; the surface is a `refract.height_field.HeightFieldWater` without gradients.
"""

from __future__ import annotations

import numpy as np

from refract import kernels
from refract._solvers import solver

# Rounding of a clearance [m], as part of its size.
_ROUNDING = 1e-12
# A leg that has this part of its length to go has arrived.
_ARRIVED = 1e-9


@solver(outputs=2)
def triangle_at(surface, x, y):
    """The wet triangle over or under places x, y (...), some wet one where there is none, and whether there is one."""
    triangle, inside = surface.mesh.locate(x.ravel(), y.ravel())
    triangle = np.where(inside & surface.wet_triangles[triangle], triangle, -1).reshape(x.shape)
    return surface.or_any(triangle), triangle >= 0


@solver(outputs=2)
def triangle_met(surface, *ends):
    """The triangle where rays from above (...) first meet the surface, some wet one where none, and whether they do."""
    origin, direction = (tuple(c.ravel() for c in v) for v in (ends[:3], ends[3:]))
    met = first_triangle(surface, origin, direction, 1.0).reshape(ends[0].shape)
    return surface.or_any(met), met >= 0


def first_triangle(surface, origin, direction, side):
    """The triangle where rays from above (side 1) or below (-1) first meet the surface; -1 for none."""
    met = np.full(origin[0].shape, -1)
    wet = surface.plain_heights[surface.triangles[surface.wet_triangles]]
    level = wet.max() if side > 0.0 else wet.min()
    fall = side * direction[2]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        start, end = surface.mesh.span(*origin[:2], *direction[:2])
        over = side * (origin[2] - level)
        start = np.maximum(start, np.where(over > 0.0, np.where(fall < 0.0, over / -fall, np.inf), 0.0))
        left = np.flatnonzero((start <= end) & np.isfinite(start))
        here = tuple((o + start * d)[left] for o, d in zip(origin[:2], direction[:2], strict=True))
        triangle, _ = surface.mesh.locate(*here)
        enters = np.ones(left.size, dtype=bool)
        t = start[left]
        for _ in range(len(surface.triangles)):
            o, d = (tuple(c[left] for c in v) for v in (origin, direction))
            leave, behind = surface.mesh.exit(triangle, *o[:2], *d[:2])
            leave = np.maximum(leave, t)
            corner, slopes = surface.planes(triangle, t)
            over, rate = (side * v for v in clearance(corner, slopes, o, d))
            hit = (over + np.where(np.isfinite(leave), leave, 0.0) * rate <= 0.0) & np.isfinite(leave)
            hit |= np.isinf(leave) & (rate < 0.0)
            # A ray that comes in from dry land below the level of the water never meets it from its own side.
            sunk = enters & (over + t * rate < -_ROUNDING * (1.0 + np.abs(over)))
            met[left[hit & ~sunk]] = triangle[hit & ~sunk]
            enters = ~surface.wet_triangles[triangle]
            going = ~hit & ~sunk & (behind >= 0)
            left, triangle, enters, t = left[going], behind[going], enters[going], leave[going]
            if left.size == 0:
                break
    return met


def clear(surface, camera, crossing, point):
    """True where neither leg to the crossing meets the surface before it gets there."""
    clear = np.ones(crossing[0].shape, dtype=bool)
    for end, side in ((camera, 1.0), (point, -1.0)):
        way = kernels.minus(crossing, end)
        length = np.sqrt(kernels.dot(way, way))
        flat = np.abs(way[2]) <= surface._steepest * np.hypot(way[0], way[1])
        origin, direction = tuple(c[flat] for c in end), tuple((w / length)[flat] for w in way)
        met = first_triangle(surface, origin, direction, side)
        corner, slopes = surface.planes(surface.or_any(met), origin[0])
        over, rate = clearance(corner, slopes, origin, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            first = np.where(met >= 0, -over / rate, np.inf)
        clear[flat] = first >= length[flat] * (1.0 - _ARRIVED)
    return clear


def clearance(corner, slopes, origin, direction):
    """Height [m] of the start of rays over planes, and its rate along the ray [-]."""
    over = origin[2] - corner[2] - slopes[0] * (origin[0] - corner[0]) - slopes[1] * (origin[1] - corner[1])
    return over, direction[2] - slopes[0] * direction[0] - slopes[1] * direction[1]
