"""The paths of pixels through the water, and where other views see their points: one source for Dr.Jit and torch.

    camera  a row of `fields.sweep.stack.camera_table`: rotation (9), centre (3), fx, fy, cx, cy, width, height, lens
    lenses  kinds of distortion among the cameras (`refract.distortion`), none for pinholes: what is left out is not
            even traced
    legs    nine numbers of a path: its foot on the water plane (3), its slope in air (3) and in water (3), both in
            metres per metre of height; at height z over the plane the path is at ``foot + z * slope``
    plane   point, normal and index of water, as `ViewStack.plane`

Each of these numbers may be an array of the device; `fields.sweep.warping_drjit` and its twin prepare them.
"""

from __future__ import annotations

import math

from fields.sweep.stack import PINHOLE_ROW
from refract import kernels
from refract.distortion import distort, undistort

# One step leaves 0.015 px at worst in drone geometry, from 5 m over 15 m of water, and 4e-4 px rms (docs/optics.md).
CROSSING_STEPS = 1
# A ray that falls less than this per metre never reaches the plane.
LEAST_FALL = 1e-3


def legs_through(camera, u, v, plane, lenses) -> list:
    """Legs of the paths through pixel positions (u, v) [px]; NaN where a ray does not fall towards the plane.

    NaN also where the lens sees nothing; ``lenses`` is the kind of this camera alone. In a dry survey the plane is
    local z = 0 with an index of one, and both slopes agree.
    """
    xp = kernels.namespace(u)
    x, y = (u - camera[14]) / camera[12], (v - camera[15]) / camera[13]
    if lenses:
        x, y = undistort(lenses, x, y, camera[PINHOLE_ROW:])
    unscaled = [camera[c] * x + camera[3 + c] * y + camera[6 + c] for c in range(3)]
    per_length = xp.rsqrt(kernels.dot(unscaled, unscaled))
    ray = tuple(c * per_length for c in unscaled)
    point, normal, n_water = plane
    centre = camera[9:12]
    fall = kernels.dot(ray, normal)
    fall = xp.where(fall < -LEAST_FALL, fall, math.nan)
    foot = kernels.along(centre, ray, -kernels.dot(kernels.minus(centre, point), normal) / fall)
    bent = kernels.bend(ray, normal, 1.0, n_water)
    fall_wet = kernels.dot(bent, normal)
    return [*foot, *(c / fall for c in ray), *(c / fall_wet for c in bent)]


def seen_at(camera, legs, z, plane, lenses) -> tuple:
    """Pixel position (u, v) [px] in a camera, and whether inside it, of paths at height z [m] over the plane.

    ``plane`` is None in a dry survey. Inside are positions between the outermost pixel centres.
    """
    slope = kernels.chosen(z > 0.0, legs[3:6], tuple(legs[6:9]))
    point = tuple(foot + z * s for foot, s in zip(legs[:3], slope, strict=True))
    centre = tuple(camera[9:12])
    if plane is not None:
        at, normal, n_water = plane
        point, _ = kernels.crossing_of_point(centre, point, at, normal, n_water, CROSSING_STEPS)
    d = kernels.minus(point, centre)
    x, y, depth = (kernels.dot(camera[first : first + 3], d) for first in (0, 3, 6))
    if lenses:
        x, y = distort(lenses, x / depth, y / depth, camera[PINHOLE_ROW:])
        u, v = camera[12] * x + camera[14], camera[13] * y + camera[15]
    else:
        u, v = camera[12] * x / depth + camera[14], camera[13] * y / depth + camera[15]
    inside = (u >= 0.5) & (v >= 0.5) & (u < camera[16] - 0.5) & (v < camera[17] - 0.5) & (depth > 0.0)
    return u, v, inside
