"""The paths of pixels through the water, and where other views see their points: one source for Dr.Jit and torch.

    camera  a row of `fields.sweep.stack.camera_table`: rotation (9), centre (3), fx, fy, cx, cy, width, height, and
            what it has beyond a pinhole
    beyond  what cameras have beyond pinholes (`fields.sweep.stack.Beyond`); the rest is not even traced
    legs    nine numbers of a path: its foot on the water plane (3), its slope in air (3) and in water (3), both in
            metres per metre of height; at height z over the plane the path is at ``foot + z * slope``
    plane   point, normal and index of water, as `ViewStack.plane`

Each of these numbers may be an array of the device; `fields.sweep.warping_drjit` and its twin prepare them.
"""

from __future__ import annotations

import math

from fields.sweep.stack import Beyond
from refract import kernels
from refract.distortion import distort, undistort

# One step leaves 0.015 px at worst in drone geometry, from 5 m over 15 m of water, and 4e-4 px rms (docs/optics.md).
CROSSING_STEPS = 1
# A ray that falls less than this per metre never reaches the plane.
LEAST_FALL = 1e-3
# Steps towards the row of a rolling shutter that takes a point. Each leaves a twentieth of the error, or less, of at
# first some pixels.
ROLLING_STEPS = 2


def legs_through(camera, u, v, plane, beyond: Beyond) -> list:
    """Legs of the paths through pixel positions (u, v) [px]; NaN where a ray does not fall towards the plane.

    NaN also where the lens sees nothing; ``beyond`` is that of this camera alone. In a dry survey the plane is local
    z = 0 with an index of one, and both slopes agree.
    """
    xp = kernels.namespace(u)
    x, y = (u - camera[14]) / camera[12], (v - camera[15]) / camera[13]
    centre = _place(camera, v, beyond)
    if beyond.lenses:
        x, y = undistort(beyond.lenses, x, y, beyond.lens(camera))
    unscaled = [camera[c] * x + camera[3 + c] * y + camera[6 + c] for c in range(3)]
    per_length = xp.rsqrt(kernels.dot(unscaled, unscaled))
    ray = tuple(c * per_length for c in unscaled)
    point, normal, n_water = plane
    fall = kernels.dot(ray, normal)
    fall = xp.where(fall < -LEAST_FALL, fall, math.nan)
    foot = kernels.along(centre, ray, -kernels.dot(kernels.minus(centre, point), normal) / fall)
    bent = kernels.bend(ray, normal, 1.0, n_water)
    fall_wet = kernels.dot(bent, normal)
    return [*foot, *(c / fall for c in ray), *(c / fall_wet for c in bent)]


def _place(camera, v, beyond: Beyond) -> tuple:
    """Where a camera is [m] when it reads the row at v [px]."""
    centre = tuple(camera[9:12])
    return kernels.along(centre, tuple(beyond.motion(camera)), v - camera[15]) if beyond.moves else centre


def seen_at(camera, legs, z, plane, beyond: Beyond) -> tuple:
    """Pixel position (u, v) [px] in a camera, and whether inside it, of paths at height z [m] over the plane.

    ``plane`` is None in a dry survey. Inside are positions between the outermost pixel centres.
    """
    slope = kernels.chosen(z > 0.0, legs[3:6], tuple(legs[6:9]))
    point = tuple(foot + z * s for foot, s in zip(legs[:3], slope, strict=True))
    u, v, depth = _seen_from(camera, tuple(camera[9:12]), point, plane, beyond)
    for _ in range(ROLLING_STEPS if beyond.moves else 0):
        u, v, depth = _seen_from(camera, _place(camera, v, beyond), point, plane, beyond)
    inside = (u >= 0.5) & (v >= 0.5) & (u < camera[16] - 0.5) & (v < camera[17] - 0.5) & (depth > 0.0)
    return u, v, inside


def _seen_from(camera, centre, point, plane, beyond: Beyond) -> tuple:
    """Pixel position (u, v) [px] at which a camera sees a point from a place, and the depth of the point in cam [m]."""
    if plane is not None:
        at, normal, n_water = plane
        point, _ = kernels.crossing_of_point(centre, point, at, normal, n_water, CROSSING_STEPS)
    d = kernels.minus(point, centre)
    x, y, depth = (kernels.dot(camera[first : first + 3], d) for first in (0, 3, 6))
    if not beyond.lenses:
        return camera[12] * x / depth + camera[14], camera[13] * y / depth + camera[15], depth
    x, y = distort(beyond.lenses, x / depth, y / depth, beyond.lens(camera))
    return camera[12] * x + camera[14], camera[13] * y + camera[15], depth
