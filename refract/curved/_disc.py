"""Search disc of all paths through a curved surface, from bounds of its height, slope and curvature.

The first two steps of `refract.curved.fermat`, on numpy and Dr.Jit. Angles only occur as sines, cosines and tangents.
Suffixes _lo and _hi bound a quantity over the disc; far_w and far_a are the largest distances from P and C along x, y:

    depth          vertical depth of P under the surface; z_p the height of the surface there
    H              height of C above the level z_p
    slope, K       bounds of |grad f| and of the curvature |grad grad f|
    theta_a, _w    angle of a leg to the vertical, air and water
"""

from __future__ import annotations

from typing import Any, NamedTuple

from refract import kernels
from refract._array import namespace

# The disc is enlarged by this for rounding: some hundred operations have an error of some 1e-14.
_WIDER = 1.0 + 1e-9
# The cosine of a leg that runs along the surface, in place of zero in a denominator.
_ALONG = 1e-12
# Of the plane, whose crossing is the middle of the disc: enough for float64 (`refract.projection.EXACT_STEPS`).
_FLAT_STEPS = 4


class Bounds(NamedTuple):
    """Bounds of a surface over a disc: heights [m], slope [-] and curvature [1/m]."""

    z_lo: Any
    z_hi: Any
    slope: Any
    curvature: Any


class Disc(NamedTuple):
    """A disc in x, y [m] that holds every crossing, and whether the optical length is strictly convex over it."""

    x: Any
    y: Any
    radius: Any
    convex: Any


def hypot(xp, a, b):
    """Length of a vector with two components, in the library of `xp`."""
    return xp.sqrt(a * a + b * b)


def _leg(xp, run, rise):
    """Sine and cosine to the vertical of a leg that covers ``run`` and ``rise``; horizontal where rise <= 0."""
    up = xp.maximum(rise, rise * 0.0)
    length = hypot(xp, run, up)
    safe = xp.where(length > 0.0, length, length * 0.0 + 1.0)
    return run / safe, xp.where(length > 0.0, up / safe, up * 0.0 + 1.0)


def _reach(xp, surface, camera, point, depth):
    """Radius about P outside which no path crosses, and the bounds within.

    A path turns at S by at most ``acos(1 / n)``, so S lies near the chord CP. The water leg stands within the angle of
    refraction of the normal, the normal within the slope of the vertical: that bounds the radius by the depth.
    A smaller radius bounds the incidence better, and the incidence the radius: three rounds reach what there is.
    """
    n = surface.n_water
    D = hypot(xp, camera[0] - point[0], camera[1] - point[1])
    chord = hypot(xp, D, camera[2] - point[2])
    R = D + 0.5 * chord * ((n - 1.0) / (n + 1.0)) ** 0.5
    bounds = surface.bounds(point[0], point[1], R)
    bounds = bounds._replace(slope=bounds.slope + D * 0.0, curvature=bounds.curvature + D * 0.0)
    s, z_p, sine = bounds.slope, point[2] + depth, D * 0.0 + 1.0
    for _ in range(3):
        sin_w = sine / n
        cos_w = xp.sqrt(xp.maximum(1.0 - sin_w * sin_w, 0.0))
        tan_v = (sin_w + s * cos_w) / xp.maximum(cos_w - s * sin_w, _ALONG)
        R = xp.minimum(R, tan_v * (_nearer(xp, bounds, z_p, R).z_hi - point[2]))
        R = _WIDER * xp.where(s * tan_v < 1.0, xp.minimum(R, tan_v * depth / xp.maximum(1.0 - s * tan_v, _ALONG)), R)
        sine = _incidence(xp, D + R, camera[2] - _nearer(xp, bounds, z_p, R).z_hi, s)
    return R, _nearer(xp, bounds, z_p, R)


def _nearer(xp, bounds, z, run):
    """The bounds within ``run`` of a place where the surface has the height z."""
    rise = bounds.slope * run
    return bounds._replace(z_lo=xp.maximum(bounds.z_lo, z - rise), z_hi=xp.minimum(bounds.z_hi, z + rise))


def _incidence(xp, run, rise, slope):
    """Sine of the largest angle between the normal and an air leg that covers ``run`` over at least ``rise``."""
    sine, cosine = _leg(xp, run, rise)
    leaning = (sine + slope * cosine) / xp.sqrt(1.0 + slope * slope)
    return xp.where(cosine <= slope * sine, 1.0, leaning)


def search_disc(surface, camera, point, depth) -> Disc:
    """The disc that holds every crossing; ``depth`` is positive, and the camera stands above the surface.

    Let S0 be the crossing of the level through the surface above P, and M the length of paths over that level. At a
    true crossing S, |grad M| is at most G: there the horizontal parts of the rays differ by no more than
    ``slope (n cos_w - cos_a)`` (Snell), and moving S to the level changes them by ``sin cos^2 / rise`` per metre and
    leg. From S0, where it is zero, |grad M| grows at least like ``n sin`` of the leg in water and like ``sin`` of that
    in air, each taken at its largest reach; where that exceeds G, there is no crossing.
    """
    xp = namespace(*camera, *point)
    n = surface.n_water
    R, bounds = _reach(xp, surface, camera, point, depth)
    D = hypot(xp, camera[0] - point[0], camera[1] - point[1])
    z_p = point[2] + depth
    is_between = (bounds.z_lo > point[2]) & (camera[2] > bounds.z_hi)
    H = xp.where(is_between, camera[2] - z_p, 1.0)
    share = kernels.air_share(D * D, H, depth, n, _FLAT_STEPS)
    run_w, run_a = (1.0 - share) * D, share * D
    radius = R + run_w
    for _ in range(3):  # each round starts from the bounds of the one before
        far_w, far_a = xp.minimum(R, run_w + radius), xp.minimum(D + R, run_a + radius)
        bounds = _nearer(xp, bounds, z_p, far_w)
        h_lo, H_lo = (
            xp.where(is_between, bounds.z_lo - point[2], 1.0),
            xp.where(is_between, camera[2] - bounds.z_hi, 1.0),
        )
        sine = _incidence(xp, far_a, H_lo, bounds.slope)
        turn = xp.sqrt(xp.maximum(n * n - sine * sine, 0.0)) - xp.sqrt(xp.maximum(1.0 - sine * sine, 0.0))
        lift = n * xp.minimum(far_w / h_lo, 0.385) / h_lo + xp.minimum(far_a / H_lo, 0.385) / H_lo  # sin cos^2 <= 0.385
        G = bounds.slope * turn + lift * xp.maximum(bounds.z_hi - z_p, z_p - bounds.z_lo)
        for run, rise, excess in ((run_w, depth, G / n), (run_a, H, G)):
            most = run / hypot(xp, run, rise) + excess
            reach = rise * most / xp.sqrt(xp.maximum(1.0 - most * most, _ALONG))
            radius = xp.where(most < 1.0 - _ALONG, xp.minimum(radius, _WIDER * reach - run), radius)
    use = is_between & (radius < R)
    x = xp.where(use, camera[0] + share * (point[0] - camera[0]), point[0])
    y = xp.where(use, camera[1] + share * (point[1] - camera[1]), point[1])
    disc = Disc(x, y, xp.where(use, radius, R), is_between)
    return disc._replace(convex=is_between & _convex(xp, n, camera, point, disc, bounds))


def _convex(xp, n, camera, point, disc, bounds):
    """True where the optical length is strictly convex over the disc, and both legs are steeper than any slope.

    Along a tangent e = (v, v . grad f) the second derivative is ``|u_a x e|^2 / a + n |u_w x e|^2 / w
    + (n cos_w - cos_a) v . f'' v``, with legs a and w; a leg at theta to the vertical and a tangent within sigma of
    the horizontal make ``|u x e| >= cos(theta + sigma)``.
    """
    z_lo, z_hi, s, K = bounds
    cos_s = 1.0 / xp.sqrt(1.0 + s * s)
    least, most, steep = [], [], disc.radius >= 0.0
    bend = disc.radius * 0.0
    for end, weight, rise_lo, rise_hi in (
        (camera, 1.0, camera[2] - z_hi, camera[2] - z_lo),
        (point, n, z_lo - point[2], z_hi - point[2]),
    ):
        run = hypot(xp, disc.x - end[0], disc.y - end[1])
        sine, cosine = _leg(xp, run + disc.radius, rise_lo)
        _, cosine_hi = _leg(xp, xp.maximum(run - disc.radius, run * 0.0), rise_hi)
        leaning = xp.maximum(cosine - sine * s, cosine * 0.0) * cos_s
        bend = bend + weight * leaning * leaning * cosine / rise_hi
        steep = steep & (cosine > sine * s)
        least.append(weight * cosine)
        most.append(weight * cosine_hi)
    return steep & (bend > K * xp.maximum(most[1] - least[0], most[0] - least[1]))
