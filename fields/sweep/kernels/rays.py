"""The paths of pixels through the water, and where other views see their points: one source for Dr.Jit and torch.

All of it is in the frame of the water plane (`stack.PlaneFrame`): its z is the height over the plane.

    camera  numbers of one camera, a row of `stack.camera_table`: rotation (9), centre (3), fx, fy, cx, cy, width,
            height, and what it has beyond a pinhole
    beyond  what cameras have beyond pinholes (`stack.Beyond`); the rest is not even traced
    legs    six numbers of a path: x and y of its foot on the water plane, its slope in air (2) and in water (2), both
            in metres per metre of height; at height z the path is at ``foot + z * slope``
    n_water index of water, 1 in a dry survey

Another photograph shows a straight path as a line along which positions are the ratio of two linear functions of the
height. A bent path deviates from that little, and smoothly while it stays on one side of the water. So three points
that are projected exactly tell where the others are: to 1e-5 px rms over 6 px, 1e-3 px over 32 px.

    course  seven numbers: u and v of the first point [px], from there to the last one (2), how far the middle is ahead
            on this way, and how far it is beside it, times four (2)

Each of these numbers may be an array of the device; `drjit_kernels` and its twin prepare them.
"""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import numpy as np

from fields.sweep.kernels.flat import flat_of, given, where_true
from fields.sweep.kernels.stack import Beyond, ViewStack
from refract import kernels
from refract.distortion import distort, undistort

# One step leaves 0.015 px at worst in drone geometry, from 5 m over 15 m of water, and 4e-4 px rms (docs/optics.md).
CROSSING_STEPS = 1
# A ray that falls less than this per metre never reaches the plane.
LEAST_FALL = 1e-3
# Steps towards the row of a rolling shutter that takes a point. Each leaves a twentieth of the error, or less, of at
# first some pixels.
ROLLING_STEPS = 2
# Numbers of a path under water that does not move.
_LEGS = 6
# The water plane in its own frame.
_POINT, _NORMAL = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
# Rungs, of a pixel or less each, that one course is good for.
MOST_RUNGS = 32
# Where a way is shorter than this [px], nothing is ahead on it.
_SHORTEST_PX = 0.03


def legs_through(camera, u, v, n_water, beyond: Beyond) -> list:
    """Legs of the paths through pixel positions (u, v) [px]; NaN where a ray does not fall towards the plane.

    NaN also where the lens sees nothing; ``beyond`` is that of this camera alone. In a dry survey both slopes agree.
    """
    xp = kernels.namespace(u)
    x, y = (u - camera[14]) / camera[12], (v - camera[15]) / camera[13]
    centre = _place(camera, v, beyond)
    if beyond.lenses:
        x, y = undistort(beyond.lenses, x, y, beyond.lens(camera))
    unscaled = [camera[c] * x + camera[3 + c] * y + camera[6 + c] for c in range(3)]
    per_length = xp.rsqrt(kernels.dot(unscaled, unscaled))
    ray = tuple(c * per_length for c in unscaled)
    fall = xp.where(ray[2] < -LEAST_FALL, ray[2], math.nan)
    air = ray[0] / fall, ray[1] / fall
    bent = kernels.bend(ray, _NORMAL, 1.0, n_water)
    foot = (c - centre[2] * slope for c, slope in zip(centre[:2], air, strict=True))
    # As an array: legs are gathered pixel by pixel.
    own = [beyond.tide(camera) + 0.0 * u] if beyond.tides else []
    return [*foot, *air, bent[0] / bent[2], bent[1] / bent[2], *own]


def point_at(legs, z) -> tuple:
    """The point of a path at height z [m]."""
    xp = kernels.namespace(z)
    own = z if len(legs) == _LEGS else z - legs[_LEGS]
    return *(legs[c] + own * xp.where(own > 0.0, legs[2 + c], legs[4 + c]) for c in range(2)), z


def _place(camera, v, beyond: Beyond) -> tuple:
    """Where a camera is [m], over its own water, when it reads the row at v [px]."""
    centre = tuple(camera[9:12])
    return kernels.along(centre, tuple(beyond.motion(camera)), v - camera[15]) if beyond.moves else centre


def seen_at(camera, point, n_water, beyond: Beyond, steps: int = CROSSING_STEPS) -> tuple:
    """Pixel position (u, v) [px] of a point in a camera, and whether inside its image.

    Parameters as of `place_at`.
    """
    u, v, depth = place_at(camera, point, n_water, beyond, steps)
    return u, v, is_inside(camera, u, v) & (depth > 0.0)


def is_inside(camera, u, v):
    """Whether positions (u, v) [px] lie between the outermost pixel centres of an image."""
    return (u >= 0.5) & (v >= 0.5) & (u < camera[16] - 0.5) & (v < camera[17] - 0.5)


def place_at(camera, point, n_water, beyond: Beyond, steps: int = CROSSING_STEPS) -> tuple:
    """Pixel position (u, v) [px] of a point in a camera, and its depth there [m].

    ``n_water`` is None in a dry survey. ``steps`` are those of `refract.kernels.air_share`.
    """
    if beyond.tides:
        point = (point[0], point[1], point[2] - beyond.tide(camera))
    u, v, depth = _seen_from(camera, tuple(camera[9:12]), point, n_water, beyond, steps)
    for _ in range(ROLLING_STEPS if beyond.moves else 0):
        u, v, depth = _seen_from(camera, _place(camera, v, beyond), point, n_water, beyond, steps)
    return u, v, depth


def _seen_from(camera, centre, point, n_water, beyond: Beyond, steps: int) -> tuple:
    """Pixel position (u, v) [px] at which a camera sees a point from a place, and the depth of the point in cam [m]."""
    if n_water is not None:
        point, _ = kernels.crossing_of_point(centre, point, _POINT, _NORMAL, n_water, steps)
    d = kernels.minus(point, centre)
    x, y, depth = (kernels.dot(camera[first : first + 3], d) for first in (0, 3, 6))
    if not beyond.lenses:
        return camera[12] * x / depth + camera[14], camera[13] * y / depth + camera[15], depth
    x, y = distort(beyond.lenses, x / depth, y / depth, beyond.lens(camera))
    return camera[12] * x + camera[14], camera[13] * y + camera[15], depth


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
