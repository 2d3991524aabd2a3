"""The way of a pixel's points through other photographs, up a ladder of heights: one source for Dr.Jit and torch.

Another photograph shows a straight path as a line along which positions are the ratio of two linear functions of the
height. A bent path deviates from that little, and smoothly while it stays on one side of the water. So three points
that are projected exactly tell where the others are: to 1e-5 px rms over 6 px, 1e-3 px over 32 px.

    course  seven numbers: u and v of the first point [px], from there to the last one (2), how far the middle is ahead
            on this way, and how far it is beside it, times four (2)
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from fields.sweep.flat import flat_of, given, where_true
from fields.sweep.legs import is_inside
from fields.sweep.stack import ViewStack
from refract import kernels

# Rungs, of a pixel or less each, that one course is good for.
MOST_RUNGS = 32
# Where a way is shorter than this [px], nothing is ahead on it.
_SHORTEST_PX = 0.03


def sections(rungs: int) -> list[range]:
    """The rungs of a ladder in parts for a course each, of about the same length."""
    ends = np.linspace(0, rungs, -(-rungs // MOST_RUNGS) + 1).round().astype(int).tolist()
    return [range(first, end) for first, end in pairwise(ends)]


def through_water(stack: ViewStack, start: Any, step: float, part: range) -> Any:
    """Pixels (n,) int whose rungs, from heights ``start`` [m], are not all on one side of the water.

    Where the heights are, on the host or on the device.
    """
    if stack.n_water is None:
        return np.empty(0, dtype=np.int64)
    tide = max(abs(camera.tide) for camera in stack.cameras)
    low, high = part.start * step - tide, (part.stop - 1) * step + tide
    if isinstance(start, np.ndarray):
        return np.flatnonzero((start < -low) & (start > -high))
    start = flat_of(start)
    return where_true((start < given(start, -low)) & (start > given(start, -high)))


def in_front(place) -> tuple:
    """A place (u, v) of (u, v, depth); NaN where that is behind the camera."""
    u, v, depth = place
    xp = kernels.namespace(u)
    return xp.where(depth > 0.0, u, math.nan), xp.where(depth > 0.0, v, math.nan)


def course_through(places) -> list:
    """The course through three places (u, v): of the first, the middle and the last point of ladders."""
    (u, v), (u_middle, v_middle), (u_last, v_last) = places
    xp = kernels.namespace(u)
    way, middle = (u_last - u, v_last - v), (u_middle - u, v_middle - v)
    squared = way[0] * way[0] + way[1] * way[1]
    is_way = squared > _SHORTEST_PX**2
    share = (middle[0] * way[0] + middle[1] * way[1]) / xp.where(is_way, squared, 1.0)
    share = xp.where(is_way, share, 0.5)
    ahead = (2.0 * share - 1.0) / (1.0 - share)
    beside = (4.0 * (m - share * w) for m, w in zip(middle, way, strict=True))
    return [u, v, *way, ahead, *beside]


def place_on(course, at, camera) -> tuple:
    """Pixel position (u, v) [px] at a share of the ladder, 0 to 1, and whether inside the image."""
    u, v, along_u, along_v, ahead, beside_u, beside_v = course
    share = (1.0 + ahead) * at / (1.0 + ahead * at)
    bump = at * (1.0 - at)
    u, v = u + along_u * share + beside_u * bump, v + along_v * share + beside_v * bump
    return u, v, is_inside(camera, u, v)
