"""Rays of pixels, lookups in images and comparisons of height maps: kernels written once for Dr.Jit and torch.

P pixels of a view, flat; heights are over the plane of the water, in whose frame points are
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fields.sweep.kernels.arrays import (
    arange,
    evaluate,
    floats,
    gather,
    host,
    indices,
    integer_part,
    scalar,
    scatter,
    to_float,
    zeros_of,
)
from fields.sweep.kernels.rays import point_at, project, refracted_rays
from fields.sweep.kernels.stack import CameraTerms, ViewStack, camera_table
from refract import kernels

# Views that one kernel projects into: several kernels take no longer, compile faster and serve any number.
VIEWS_PER_KERNEL = 4


def groups(views: list) -> list[list]:
    """Lists per view in groups of `VIEWS_PER_KERNEL`; the last may have fewer."""
    return [views[first : first + VIEWS_PER_KERNEL] for first in range(0, len(views), VIEWS_PER_KERNEL)]


def rays_of_rows(stack: ViewStack, view: int, first_row: int, rows: int) -> list:
    """Rays (`fields.sweep.kernels.rays`) of a strip of pixels of `view`: six floats of P = rows * width, or more."""
    index = arange(floats(stack.device, np.zeros(1, dtype=np.float32)), rows * stack.cameras[view].width)
    return _refracted_rays(stack, view, index + scalar(index, first_row * stack.cameras[view].width))


def rays_of_pixels(stack: ViewStack, view: int, pixels: np.ndarray) -> list:
    """Rays of chosen pixels (flat indices) of a view."""
    return _refracted_rays(stack, view, indices(stack.device, pixels))


def _refracted_rays(stack: ViewStack, view: int, index: Any) -> list:
    width, cameras = scalar(index, stack.cameras[view].width), [stack.cameras[view]]
    line = index // width
    u, v = to_float(index - line * width) + 0.5, to_float(line) + 0.5
    terms = CameraTerms.of(cameras)
    camera = [scalar(u, float(number)) for number in camera_table(cameras, terms, stack.kernel_water)[0]]
    rays = refracted_rays(camera, u, v, stack.kernel_water, terms)
    evaluate(*rays)
    return rays


def rays_and_heights(stack: ViewStack, view: int, pixels: np.ndarray) -> tuple[list, Any]:
    """Rays of chosen pixels (flat indices) of a view, and their heights in a stack of height maps."""
    own_height = gather(stack.pixels(view), indices(stack.device, pixels))
    evaluate(own_height)
    return rays_of_pixels(stack, view, pixels), own_height


def project_rays(stack: ViewStack, rays: list, z: Any, view: int) -> tuple[Any, Any, Any]:
    """Pixel position in `view` of each ray at its height `z`, and whether inside the image."""
    return project(stack.camera_rows[view], point_at(rays, z), stack.kernel_water, stack.terms)


def corner_of(stack: ViewStack, view: int, u: Any, v: Any, inside: Any) -> tuple[Any, Any, Any]:
    """Flat index of the upper left of the four pixels about (u, v), and the offset from it [px]."""
    xp = kernels.namespace(u)
    x, y = xp.where(inside, u - 0.5, 0.0), xp.where(inside, v - 0.5, 0.0)
    x0, y0 = integer_part(x), integer_part(y)
    return y0 * scalar(x0, stack.cameras[view].width) + x0, x - to_float(x0), y - to_float(y0)


def bilinear(corners: list, fx: Any, fy: Any) -> Any:
    """Bilinear interpolation between four corners, row by row."""
    fma = kernels.namespace(fx).fma
    a, b, c, d = corners
    top, bottom = fma(fx, b - a, a), fma(fx, d - c, c)
    return fma(fy, bottom - top, top)


def four_about(stack: ViewStack, view: int, corner: Any) -> list:
    """Flat indices of the four pixels of which a corner is the upper left."""
    width = scalar(corner, stack.cameras[view].width)
    return [corner, corner + 1, corner + width, corner + width + 1]


def sample(stack: ViewStack, view: int, u: Any, v: Any, inside: Any) -> Any:
    """Bilinear lookup in image `view` at pixel position (u, v); NaN where not inside."""
    corner, fx, fy = corner_of(stack, view, u, v, inside)
    corners = [gather(stack.pixels(view), each) for each in four_about(stack, view, corner)]
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
    xp, most = kernels.namespace(own_height), scalar(own_height, float(tolerance))
    count, total, square = (zeros_of(own_height) for _ in range(3))
    for group in groups(peers):
        for peer in group:
            difference = sample(stack, peer, *project_rays(stack, rays, own_height, peer)) - own_height
            near = xp.abs(difference) < most
            difference = xp.where(near, difference, 0.0)
            count, total, square = count + to_float(near), total + difference, square + difference * difference
        evaluate(count, total, square)
    return count, total, square


def count_seeing_through(stack: ViewStack, view: int, peers: list[int], tolerance: float, pixels: np.ndarray) -> Any:
    """Number of peers (P) that see through the points of pixels (flat indices) of height map `view` to something lower.

    All four of the peer's pixels about the point are lower by more than `tolerance` [m]; NaN sees nothing.
    """
    rays, own_height = rays_and_heights(stack, view, pixels)
    count = zeros_of(own_height)
    least = own_height - scalar(own_height, float(tolerance))
    for group in groups(peers):
        for peer in group:
            u, v, lower = project_rays(stack, rays, own_height, peer)
            for place in four_about(stack, peer, corner_of(stack, peer, u, v, lower)[0]):
                lower = lower & (gather(stack.pixels(peer), place) < least)
            count = count + to_float(lower)
        evaluate(count)
    return count


def find_duplicates(
    stack: ViewStack, rays: list, own_height: Any, other: int, tolerance: float, close_m: float
) -> tuple[np.ndarray, np.ndarray]:
    """Pixels (P) bool of height map `other` that show the points of rays at their heights, and those close to them.

    The first are the four pixels about the projection of each path, where their height is within `tolerance` [m]; the
    second those of them whose height is within `close_m` of the path's, or of that of the map between the four.
    """
    heights = stack.pixels(other)
    xp, least, most = kernels.namespace(heights), scalar(heights, float(tolerance)), scalar(heights, float(close_m))
    claimed, close = (zeros_of(heights) for _ in range(2))
    u, v, inside = project_rays(stack, rays, own_height, other)
    corner, fx, fy = corner_of(stack, other, u, v, inside)
    four = four_about(stack, other, corner)
    found = [gather(heights, place) for place in four]
    interpolated = bilinear(found, fx, fy)
    for place, height in zip(four, found, strict=True):
        off = xp.abs(height - own_height)
        same = inside & (off < least)
        near = same & (xp.minimum(off, xp.abs(height - interpolated)) < most)
        scatter(claimed, place, to_float(same), same)
        scatter(close, place, to_float(near), near)
    evaluate(claimed, close)
    return host(stack.device, claimed) > 0.0, host(stack.device, close) > 0.0


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
    heights, known = [gather(stack.pixels(view), place) for place in four], floats(stack.device, trusted)
    xp, reach = kernels.namespace(u), scalar(u, float(close_m))
    low, high = xp.minimum(heights[0], heights[1]), xp.maximum(heights[0], heights[1])
    for height in heights[2:]:
        low, high = xp.minimum(low, height), xp.maximum(high, height)
    below = high + reach < points[2]
    spans, through, matches = inside & ~below & (low - reach < points[2]), inside & below, inside & False
    for place, height in zip(four, heights, strict=True):
        is_trusted = gather(known, place) > 0.0
        through, matches = through & is_trusted, matches | (is_trusted & (xp.abs(height - points[2]) < reach))
    found = [to_float(votes) for votes in (spans, through, matches & inside)]
    evaluate(*found)
    spans, through, matches = (host(stack.device, votes) > 0.0 for votes in found)
    return spans, through, matches
