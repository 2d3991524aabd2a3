"""Refracted rays of pixels, and projection of their points into other views: one source for Dr.Jit and torch.

All of it is in the frame of the water (`fields.sweep.kernels.stack`): its z is the height over the plane.

    camera  numbers of one camera, a row of `stack.camera_table`: rotation (9), centre (3), fx, fy, cx, cy, width,
            height, and what it has beyond a pinhole
    terms   what cameras have beyond pinholes (`stack.CameraTerms`); the rest is not even traced
    legs    six numbers of a path: x and y of its foot on the water plane, its slope in air (2) and in water (2), both
            in metres per metre of height; at height z the path is at ``foot + z * slope``
    water   `fields.sweep.kernels.stack.KernelWater`: where rays bend, and where points are seen through the surface

In another photograph a straight ray is a line, along which positions are the ratio of two linear functions of the
height. A refracted ray deviates from that little, and smoothly on one side of the water. So three points that are
projected exactly define an epipolar curve for the others: to 1e-5 px rms over 6 px, 1e-3 px over 32 px.

    curve   seven numbers: u and v of the first point [px], the chord from it to the last one (2), how far the middle
            one is ahead along the chord, and its offset from the chord, times four (2)

Each of these numbers may be an array of the device; `drjit_kernels` and `torch_kernels` prepare them.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np

from fields.sweep.kernels.stack import CameraTerms, KernelWater, ViewStack
from refract import kernels
from refract.distortion import distort, undistort

# One step leaves 0.015 px at worst in drone geometry, from 5 m over 15 m of water, and 4e-4 px rms (docs/optics.md).
CROSSING_STEPS = 1
LEAST_DESCENT = 1e-3  # A ray that descends less than this per metre never reaches the plane
# Iterations for the row at which a rolling shutter sees a point. Each leaves a twentieth of the error, or less, of at
# first some pixels.
ROLLING_STEPS = 2
_RAY_NUMBERS = 6  # Numbers of a ray without tides
MOST_HYPOTHESES = 32  # Hypotheses, a pixel or less apart, that one curve is good for
_SHORTEST_PX = 0.03  # Chords shorter than this [px] have no direction


def refracted_rays(camera, u, v, water: KernelWater, terms: CameraTerms) -> list:
    """Refracted rays through pixel positions (u, v) [px]; NaN where a ray does not descend to the plane.

    NaN also where the lens sees nothing; ``terms`` is that of this camera alone. In a dry survey both slopes agree.
    """
    xp = kernels.namespace(u)
    x, y = (u - camera[14]) / camera[12], (v - camera[15]) / camera[13]
    centre = _centre_at_row(camera, v, terms)
    if terms.lenses:
        x, y = undistort(terms.lenses, x, y, terms.lens(camera))
    unscaled = [camera[c] * x + camera[3 + c] * y + camera[6 + c] for c in range(3)]
    per_length = xp.rsqrt(kernels.dot(unscaled, unscaled))
    ray = tuple(c * per_length for c in unscaled)
    descent = xp.where(ray[2] < -LEAST_DESCENT, ray[2], math.nan)
    air = ray[0] / descent, ray[1] / descent
    bent = water.bend(ray)
    foot = (c - centre[2] * slope for c, slope in zip(centre[:2], air, strict=True))
    # As an array: rays are gathered pixel by pixel.
    own = [terms.tide(camera) + 0.0 * u] if terms.tides else []
    return [*foot, *air, bent[0] / bent[2], bent[1] / bent[2], *own]


def point_at(rays, z) -> tuple:
    """Point of a ray at height z [m]."""
    xp = kernels.namespace(z)
    own = z if len(rays) == _RAY_NUMBERS else z - rays[_RAY_NUMBERS]
    return *(rays[c] + own * xp.where(own > 0.0, rays[2 + c], rays[4 + c]) for c in range(2)), z


def _centre_at_row(camera, v, terms: CameraTerms) -> tuple:
    """Camera centre [m], over its own water level, when the rolling shutter reads the row at v [px]."""
    centre = tuple(camera[9:12])
    return kernels.point_at_distance(centre, tuple(terms.motion(camera)), v - camera[15]) if terms.moves else centre


def project(camera, point, water: KernelWater, terms: CameraTerms, steps: int = CROSSING_STEPS) -> tuple:
    """Pixel position (u, v) [px] of a point in a camera, and whether inside its image.

    Parameters as of `project_with_depth`.
    """
    u, v, depth = project_with_depth(camera, point, water, terms, steps)
    return u, v, is_inside(camera, u, v) & (depth > 0.0)


def is_inside(camera, u, v):
    """Whether positions (u, v) [px] lie between the outermost pixel centres of an image."""
    return (u >= 0.5) & (v >= 0.5) & (u < camera[16] - 0.5) & (v < camera[17] - 0.5)


def project_with_depth(camera, point, water: KernelWater, terms: CameraTerms, steps: int = CROSSING_STEPS) -> tuple:
    """Pixel position (u, v) [px] of a point in a camera, and its depth there [m].

    ``steps`` are those of `KernelWater.crossing`.
    """
    if terms.tides:
        point = (point[0], point[1], point[2] - terms.tide(camera))
    u, v, depth = _project_from(camera, tuple(camera[9:12]), point, water, terms, steps)
    for _ in range(ROLLING_STEPS if terms.moves else 0):
        u, v, depth = _project_from(camera, _centre_at_row(camera, v, terms), point, water, terms, steps)
    return u, v, depth


def _project_from(camera, centre, point, water: KernelWater, terms: CameraTerms, steps: int) -> tuple:
    """Pixel position (u, v) [px] of a point from a given camera centre, and its depth in cam [m]."""
    d = kernels.minus(water.crossing(centre, point, steps), centre)
    x, y, depth = (kernels.dot(camera[first : first + 3], d) for first in (0, 3, 6))
    if not terms.lenses:
        return camera[12] * x / depth + camera[14], camera[13] * y / depth + camera[15], depth
    x, y = distort(terms.lenses, x / depth, y / depth, terms.lens(camera))
    return camera[12] * x + camera[14], camera[13] * y + camera[15], depth


def segments(count: int) -> list[range]:
    """Ranges of hypotheses, of about the same length, that one curve each is good for."""
    ends = np.linspace(0, count, -(-count // MOST_HYPOTHESES) + 1).round().astype(int).tolist()
    return [range(first, end) for first, end in pairwise(ends)]


def straddling_pixels(stack: ViewStack, start: np.ndarray, step: float, part: range) -> np.ndarray:
    """Pixels (n,) int whose hypotheses from ``start`` [m] on lie on both sides of the water surface."""
    if not stack.kernel_water.is_refracting:
        return np.empty(0, dtype=np.int64)
    tide = max(abs(camera.tide) for camera in stack.cameras)
    low, high = part.start * step - tide, (part.stop - 1) * step + tide
    return np.flatnonzero((start < -low) & (start > -high))


def in_front_of_camera(place) -> tuple:
    """Pixel position (u, v) of (u, v, depth); NaN behind the camera."""
    u, v, depth = place
    xp = kernels.namespace(u)
    return xp.where(depth > 0.0, u, math.nan), xp.where(depth > 0.0, v, math.nan)


def fit_curve(places) -> list:
    """Epipolar curve through the pixel positions (u, v) of the first, middle and last hypothesis."""
    (u, v), (u_middle, v_middle), (u_last, v_last) = places
    xp = kernels.namespace(u)
    chord, middle = (u_last - u, v_last - v), (u_middle - u, v_middle - v)
    squared = chord[0] * chord[0] + chord[1] * chord[1]
    is_long = squared > _SHORTEST_PX**2
    share = (middle[0] * chord[0] + middle[1] * chord[1]) / xp.where(is_long, squared, 1.0)
    share = xp.where(is_long, share, 0.5)
    perspective = (2.0 * share - 1.0) / (1.0 - share)
    lateral = (4.0 * (m - share * w) for m, w in zip(middle, chord, strict=True))
    return [u, v, *chord, perspective, *lateral]


def point_on_curve(curve, at, camera) -> tuple:
    """Pixel position (u, v) [px] at a fraction 0 to 1 of the range of hypotheses, and whether inside the image."""
    u, v, chord_u, chord_v, perspective, lateral_u, lateral_v = curve
    share = (1.0 + perspective) * at / (1.0 + perspective * at)
    parabola = at * (1.0 - at)
    u, v = u + chord_u * share + lateral_u * parabola, v + chord_v * share + lateral_v * parabola
    return u, v, is_inside(camera, u, v)
