"""Rays of pixels, projection, lookups in images and comparisons of height maps: one source for Dr.Jit and torch.

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

import math
from itertools import pairwise
from typing import Any

import numpy as np

from fields.sweep.kernels import arrays
from fields.sweep.kernels.stack import CameraTerms, KernelWater, ViewStack, camera_table
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


def project_in_front(camera, point, water: KernelWater, terms: CameraTerms) -> tuple:
    """Pixel position (u, v) [px] of a point; NaN behind the camera."""
    u, v, depth = project_with_depth(camera, point, water, terms)
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


# Views that one kernel projects into: several kernels take no longer, compile faster and serve any number.
VIEWS_PER_KERNEL = 4


def groups(views: list) -> list[list]:
    """Lists per view in groups of `VIEWS_PER_KERNEL`; the last may have fewer."""
    return [views[first : first + VIEWS_PER_KERNEL] for first in range(0, len(views), VIEWS_PER_KERNEL)]


def rays_of_rows(stack: ViewStack, view: int, first_row: int, rows: int) -> list:
    """Rays (`fields.sweep.kernels.rays`) of a strip of pixels of `view`: six floats of P = rows * width, or more."""
    index = arrays.arange(arrays.floats(stack.device, np.zeros(1, dtype=np.float32)), rows * stack.cameras[view].width)
    return _refracted_rays(stack, view, index + arrays.scalar(index, first_row * stack.cameras[view].width))


def rays_of_pixels(stack: ViewStack, view: int, pixels: np.ndarray) -> list:
    """Rays of chosen pixels (flat indices) of a view."""
    return _refracted_rays(stack, view, arrays.indices(stack.device, pixels))


def _refracted_rays(stack: ViewStack, view: int, index: Any) -> list:
    width, cameras = arrays.scalar(index, stack.cameras[view].width), [stack.cameras[view]]
    line = index // width
    u, v = arrays.to_float(index - line * width) + 0.5, arrays.to_float(line) + 0.5
    terms = CameraTerms.of(cameras)
    camera = [arrays.scalar(u, float(number)) for number in camera_table(cameras, terms, stack.kernel_water)[0]]
    rays = refracted_rays(camera, u, v, stack.kernel_water, terms)
    arrays.evaluate(*rays)
    return rays


def rays_and_heights(stack: ViewStack, view: int, pixels: np.ndarray) -> tuple[list, Any]:
    """Rays of chosen pixels (flat indices) of a view, and their heights in a stack of height maps."""
    own_height = arrays.gather(stack.pixels(view), arrays.indices(stack.device, pixels))
    arrays.evaluate(own_height)
    return rays_of_pixels(stack, view, pixels), own_height


def project_rays(stack: ViewStack, rays: list, z: Any, view: int) -> tuple[Any, Any, Any]:
    """Pixel position in `view` of each ray at its height `z`, and whether inside the image."""
    return project(stack.camera_rows[view], point_at(rays, z), stack.kernel_water, stack.terms)


def corner_of(stack: ViewStack, view: int, u: Any, v: Any, inside: Any) -> tuple[Any, Any, Any]:
    """Flat index of the upper left of the four pixels about (u, v), and the offset from it [px]."""
    xp = kernels.namespace(u)
    x, y = xp.where(inside, u - 0.5, 0.0), xp.where(inside, v - 0.5, 0.0)
    x0, y0 = arrays.integer_part(x), arrays.integer_part(y)
    return y0 * arrays.scalar(x0, stack.cameras[view].width) + x0, x - arrays.to_float(x0), y - arrays.to_float(y0)


def bilinear(corners: list, fx: Any, fy: Any) -> Any:
    """Bilinear interpolation between four corners, row by row."""
    fma = kernels.namespace(fx).fma
    a, b, c, d = corners
    top, bottom = fma(fx, b - a, a), fma(fx, d - c, c)
    return fma(fy, bottom - top, top)


def four_about(stack: ViewStack, view: int, corner: Any) -> list:
    """Flat indices of the four pixels of which a corner is the upper left."""
    width = arrays.scalar(corner, stack.cameras[view].width)
    return [corner, corner + 1, corner + width, corner + width + 1]


def sample(stack: ViewStack, view: int, u: Any, v: Any, inside: Any) -> Any:
    """Bilinear lookup in image `view` at pixel position (u, v); NaN where not inside."""
    corner, fx, fy = corner_of(stack, view, u, v, inside)
    corners = [arrays.gather(stack.pixels(view), each) for each in four_about(stack, view, corner)]
    return kernels.namespace(fx).where(inside, bilinear(corners, fx, fy), math.nan)


def compare_heights(
    stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray | None = None
) -> tuple[Any, Any, Any]:
    """Height differences to the peers: each pixel of `view`, or some (flat indices), projected at its own height.

    Returns count, total, square (P) each: of the differences [m] (the peer's height there, bilinear, less the own one)
    that are below `tolerance` [m].
    """
    if pixels is None:
        rays, own_height = rays_of_rows(stack, view, 0, stack.cameras[view].height), stack.pixels(view)
    else:
        rays, own_height = rays_and_heights(stack, view, pixels)
    xp, most = kernels.namespace(own_height), arrays.scalar(own_height, float(tolerance))
    count, total, square = (arrays.zeros_of(own_height) for _ in range(3))
    for group in groups(peers):
        for peer in group:
            difference = sample(stack, peer, *project_rays(stack, rays, own_height, peer)) - own_height
            near = xp.abs(difference) < most
            difference = xp.where(near, difference, 0.0)
            count, total, square = count + arrays.to_float(near), total + difference, square + difference * difference
        arrays.evaluate(count, total, square)
    return count, total, square


def count_seeing_through(stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray) -> Any:
    """Number of peers (P) that see through the points of pixels (flat indices) of height map `view` to something lower.

    All four of the peer's pixels about the point are lower by more than `tolerance` [m]; NaN sees nothing.
    """
    rays, own_height = rays_and_heights(stack, view, pixels)
    count = arrays.zeros_of(own_height)
    least = own_height - arrays.scalar(own_height, float(tolerance))
    for group in groups(peers):
        for peer in group:
            u, v, lower = project_rays(stack, rays, own_height, peer)
            for place in four_about(stack, peer, corner_of(stack, peer, u, v, lower)[0]):
                lower = lower & (arrays.gather(stack.pixels(peer), place) < least)
            count = count + arrays.to_float(lower)
        arrays.evaluate(count)
    return count


def find_duplicates(
    stack: ViewStack, rays: list, own_height: Any, other: int, tolerance: float, close_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P) bool of height map `other` that show the points of rays at their heights, and those close to them.

    The first are the four pixels about the projection of each path, where their height is within `tolerance` [m]; the
    second those of them whose height is within `close_m` of the path's, or of that of the map between the four.
    """
    heights = stack.pixels(other)
    xp = kernels.namespace(heights)
    least, most = (arrays.scalar(heights, float(height)) for height in (tolerance, close_m))
    claimed, close = (arrays.zeros_of(heights) for _ in range(2))
    u, v, inside = project_rays(stack, rays, own_height, other)
    corner, fx, fy = corner_of(stack, other, u, v, inside)
    four = four_about(stack, other, corner)
    found = [arrays.gather(heights, place) for place in four]
    interpolated = bilinear(found, fx, fy)
    for place, height in zip(four, found, strict=True):
        off = xp.abs(height - own_height)
        same = inside & (off < least)
        near = same & (xp.minimum(off, xp.abs(height - interpolated)) < most)
        arrays.scatter(claimed, place, arrays.to_float(same), same)
        arrays.scatter(close, place, arrays.to_float(near), near)
    arrays.evaluate(claimed, close)
    return arrays.host(stack.device, claimed) > 0.0, arrays.host(stack.device, close) > 0.0


def vote_on_points(
    stack: ViewStack, points: tuple, view: int, close_m: float, trusted: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Votes of height map `view` on points (P): bool where it spans, sees through, and matches them.

    A map spans points between the lowest and the highest of its four heights about them, or within `close_m` of these.
    It sees through those above all four by more, if these are all ``trusted`` (pixels) bool. It matches those within
    `close_m` of one of the four that is trusted: beside a step the others are between two surfaces. Points are in the
    frame of the water plane.
    """
    u, v, inside = project(stack.camera_rows[view], points, stack.kernel_water, stack.terms)
    four = four_about(stack, view, corner_of(stack, view, u, v, inside)[0])
    heights, known = [arrays.gather(stack.pixels(view), place) for place in four], arrays.floats(stack.device, trusted)
    xp, reach = kernels.namespace(u), arrays.scalar(u, float(close_m))
    low, high = xp.minimum(heights[0], heights[1]), xp.maximum(heights[0], heights[1])
    for height in heights[2:]:
        low, high = xp.minimum(low, height), xp.maximum(high, height)
    below = high + reach < points[2]
    spans, through, matches = inside & ~below & (low - reach < points[2]), inside & below, inside & False
    for place, height in zip(four, heights, strict=True):
        is_trusted = arrays.gather(known, place) > 0.0
        through, matches = through & is_trusted, matches | (is_trusted & (xp.abs(height - points[2]) < reach))
    found = [arrays.to_float(votes) for votes in (spans, through, matches & inside)]
    arrays.evaluate(*found)
    spans, through, matches = (arrays.host(stack.device, votes) > 0.0 for votes in found)
    return spans, through, matches
