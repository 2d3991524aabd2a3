"""The way back up through a curved surface z = f(x, y): all stationary optical paths, proven and counted.

The path from camera C over a surface point S to a bed point P has the optical length |C - S| + n |S - P|; light
takes those S where it is stationary (Fermat). Three steps, each with a bound behind it:

1. `search_disc`: no path that obeys Snell's law crosses outside this disc. It follows from bounds of the surface
   (range of height, slope, curvature), because slopes turn the refracted ray only so far.
2. If the length is strictly convex over the disc, it holds exactly one path, and Newton's steps find it.
3. Elsewhere the disc is cut into boxes until interval arithmetic proves each one empty or the home of exactly one
   path (`refract._branches`). What it cannot prove within its budget is NaN, with a count of -1.

Vectors are triples of component arrays (numpy, torch, Dr.Jit), as in `refract.kernels`; angles only occur as sines
and cosines, so that the bounds run on every library. Suffixes _lo and _hi bound a quantity over the disc:

    depth          vertical depth of P under the surface          H    height of C above a level
    slope          bound of |grad f|                              K    bound of the curvature |grad grad f|
    theta_a, _w    angle of a leg to the vertical, air and water
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple, Protocol

import numpy as np

from refract import kernels
from refract._array import as_like, as_numpy, namespace
from refract._branches import every_path

# The disc is computed in rounded arithmetic, some hundred operations long: their error is some 1e-14.
_WIDER = 1.0 + 1e-9
# The cosine of a leg that runs along the surface: instead of zero under a fraction.
_ALONG = 1e-12
# Newton's last step, as part of the camera's distance: squared, it is far below the rounding.
_SETTLED = 1e-11
# Newton's steps on a convex length take four or five; what needs more goes to the full search.
_MOST_STEPS = 10
# Of the plane, whose crossing is the middle of the disc: enough for float64 (`refract.projection.EXACT_STEPS`).
_FLAT_STEPS = 4
# A path is left without gradient where the determinant of its curvature falls below this part of the squared norm:
# it lies on a caustic, where the crossing moves infinitely fast. Grazing rays, too: 89.9 deg has 3e-6.
_FIRM = 1e-9


class Bounds(NamedTuple):
    """Bounds of a surface over a disc: heights [m], slope [-] and curvature [1/m]."""

    z_lo: Any
    z_hi: Any
    slope: Any
    curvature: Any


class Relief(Protocol):
    """What this module asks of a smooth surface, beside `refract.surfaces.WaterSurface`."""

    n_water: Any

    def derivatives(self, x, y) -> tuple:
        """Height and derivatives (f, f_x, f_y, f_xx, f_xy, f_yy); also of an `Interval`."""

    def bounds(self, x, y, radius) -> Bounds:
        """Bounds over the disc of this radius [m] about x, y."""

    def clear(self, camera, crossing, point):
        """True where the legs to the crossing meet the surface nowhere else (numpy)."""

    def detached(self) -> Relief:
        """The same surface with plain numbers and without gradients."""

    def anchor(self) -> tuple:
        """Some x, y where the surface is defined, plain numbers."""


class Disc(NamedTuple):
    """A disc in x, y [m] that holds every crossing, and whether the optical length is strictly convex over it."""

    x: Any
    y: Any
    radius: Any
    convex: Any


def path_slope(surface, camera, point, x, y):
    """Gradient (x, y) and Hessian (xx, xy, yy) of the optical length as the crossing moves over the surface.

    With unit vectors u from C and from P to S and tangents e = (1, 0, f_x) and e' = (0, 1, f_y), each leg adds
    ``weight u . e`` to the gradient, and ``weight ((e . e' - (u . e) (u . e')) / length + u_z f_xy)`` to the Hessian.
    """
    xp = namespace(x)
    z, zx, zy, zxx, zxy, zyy = surface.derivatives(x, y)
    gx = gy = hxx = hxy = hyy = 0.0
    for end, weight in ((camera, 1.0), (point, surface.n_water)):
        dx, dy, dz = x - end[0], y - end[1], z - end[2]
        per_metre = 1.0 / xp.sqrt(dx * dx + dy * dy + dz * dz)
        up = dz * per_metre
        along_x, along_y = dx * per_metre + zx * up, dy * per_metre + zy * up
        gx, gy = gx + weight * along_x, gy + weight * along_y
        stiff, lift = weight * per_metre, weight * up
        hxx = hxx + (stiff * (1.0 + zx * zx - along_x * along_x) + lift * zxx)
        hxy = hxy + (stiff * (zx * zy - along_x * along_y) + lift * zxy)
        hyy = hyy + (stiff * (1.0 + zy * zy - along_y * along_y) + lift * zyy)
    return (gx, gy), (hxx, hxy, hyy)


def together(*triples):
    """Triples in float64, all of their arrays of the same shape."""
    triples = tuple(map(kernels.double, triples))
    zero = sum(sum(triple) for triple in triples) * 0.0
    return tuple(tuple(c + zero for c in triple) for triple in triples)


def _hypot(xp, a, b):
    return xp.sqrt(a * a + b * b)


def _leg(xp, way, rise):
    """Sine and cosine to the vertical of a leg that covers ``way`` and ``rise``; horizontal where rise <= 0."""
    up = xp.maximum(rise, rise * 0.0)
    length = _hypot(xp, way, up)
    safe = xp.where(length > 0.0, length, length * 0.0 + 1.0)
    return way / safe, xp.where(length > 0.0, up / safe, up * 0.0 + 1.0)


def _reach(xp, surface, camera, point, depth):
    """Radius about P outside which no path crosses, and the bounds within.

    A path turns at S by at most ``acos(1 / n)``, so S lies near the chord CP. The water leg stands within the angle of
    refraction of the normal, the normal within the slope of the vertical: that bounds the radius by the depth.
    A smaller radius bounds the incidence better, and the incidence the radius: three rounds reach what there is.
    """
    n = surface.n_water
    D = _hypot(xp, camera[0] - point[0], camera[1] - point[1])
    chord = _hypot(xp, D, camera[2] - point[2])
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


def _nearer(xp, bounds, z, way):
    """The bounds within ``way`` of a place where the surface has the height z."""
    rise = bounds.slope * way
    return bounds._replace(z_lo=xp.maximum(bounds.z_lo, z - rise), z_hi=xp.minimum(bounds.z_hi, z + rise))


def _incidence(xp, way, rise, slope):
    """Sine of the largest angle between the normal and an air leg that covers ``way`` over at least ``rise``."""
    sine, cosine = _leg(xp, way, rise)
    leaning = (sine + slope * cosine) / xp.sqrt(1.0 + slope * slope)
    return xp.where(cosine <= slope * sine, 1.0, leaning)


def search_disc(surface, camera, point, depth) -> Disc:
    """The disc that holds every crossing; ``depth`` is positive, and the camera stands above the surface.

    About the crossing S0 of the level through the surface above P, the length M of paths over that level is strongly
    convex. At a true crossing the horizontal parts of the rays differ by at most ``slope (n cos_w - cos_a)``
    (Snell), and lifting S to the level changes them by ``sin cos^2 / rise`` per metre and leg: together G. Hence
    ``|S - S0| <= G / m`` with m the least curvature of M.
    """
    xp = namespace(*camera, *point)
    n = surface.n_water
    R, bounds = _reach(xp, surface, camera, point, depth)
    D = _hypot(xp, camera[0] - point[0], camera[1] - point[1])
    z_p = point[2] + depth
    H = camera[2] - z_p
    apart = (bounds.z_lo > point[2]) & (camera[2] > bounds.z_hi)
    share = kernels.air_share(D * D, xp.where(apart, H, 1.0), depth, n, _FLAT_STEPS)
    tight = R + (1.0 - share) * D
    for _ in range(2):  # the second round starts from the bounds of the first
        far_w, far_a = xp.minimum(R, (1.0 - share) * D + tight), xp.minimum(D + R, share * D + tight)
        bounds = _nearer(xp, bounds, z_p, far_w)
        h_lo, H_lo = xp.where(apart, bounds.z_lo - point[2], 1.0), xp.where(apart, camera[2] - bounds.z_hi, 1.0)
        sine = _incidence(xp, far_a, H_lo, bounds.slope)
        turn = xp.sqrt(xp.maximum(n * n - sine * sine, 0.0)) - xp.sqrt(xp.maximum(1.0 - sine * sine, 0.0))
        lift = n * xp.minimum(far_w / h_lo, 0.385) / h_lo + xp.minimum(far_a / H_lo, 0.385) / H_lo  # sin cos^2 <= 0.385
        G = bounds.slope * turn + lift * xp.maximum(bounds.z_hi - z_p, z_p - bounds.z_lo)
        m = n * depth * depth / _hypot(xp, far_w, depth) ** 3 + H * H / _hypot(xp, far_a, H) ** 3
        tight = xp.minimum(tight, _WIDER * G / m)
    use = apart & (tight < R)
    x = xp.where(use, camera[0] + share * (point[0] - camera[0]), point[0])
    y = xp.where(use, camera[1] + share * (point[1] - camera[1]), point[1])
    disc = Disc(x, y, xp.where(use, tight, R), apart)
    return disc._replace(convex=apart & _convex(xp, n, camera, point, disc, bounds))


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
        way = _hypot(xp, disc.x - end[0], disc.y - end[1])
        sine, cosine = _leg(xp, way + disc.radius, rise_lo)
        _, cosine_hi = _leg(xp, xp.maximum(way - disc.radius, way * 0.0), rise_hi)
        leaning = xp.maximum(cosine - sine * s, cosine * 0.0) * cos_s
        bend = bend + weight * leaning * leaning * cosine / rise_hi
        steep = steep & (cosine > sine * s)
        least.append(weight * cosine)
        most.append(weight * cosine_hi)
    return steep & (bend > K * xp.maximum(most[1] - least[0], most[0] - least[1]))


def _step(gradient, hessian):
    """Newton's step for gradient (x, y) and Hessian (xx, xy, yy)."""
    (gx, gy), (hxx, hxy, hyy) = gradient, hessian
    determinant = hxx * hyy - hxy * hxy
    return (hxy * gy - hyy * gx) / determinant, (hxy * gx - hxx * gy) / determinant


def newton(surface, camera, point, disc):
    """Newton's steps from the middle of the disc, kept inside; returns x, y and True where they have settled."""
    xp = namespace(*camera, *point)
    chord = _hypot(xp, _hypot(xp, camera[0] - point[0], camera[1] - point[1]), camera[2] - point[2])
    x, y, settled = disc.x, disc.y, chord < 0.0
    for _ in range(_MOST_STEPS):
        step_x, step_y = _step(*path_slope(surface, camera, point, x, y))
        settled = _hypot(xp, step_x, step_y) <= _SETTLED * chord
        out_x, out_y = x + step_x - disc.x, y + step_y - disc.y
        out = _hypot(xp, out_x, out_y)
        back = xp.where(out > disc.radius, disc.radius / xp.where(out > 0.0, out, out * 0.0 + 1.0), out * 0.0 + 1.0)
        x, y = disc.x + back * out_x, disc.y + back * out_y
        if xp.name == "numpy" and settled.all():
            break
    return x, y, settled


def _least(surface, camera, point, disc):
    """Of all clear paths (numpy): the crossing of the shortest, and how many there are; -1 where that is open."""
    owner, x, y, unsettled = every_path(surface, path_slope, camera, point, disc)
    camera, point = tuple(c[owner] for c in camera), tuple(p[owner] for p in point)
    crossing = x, y, surface.height(x, y)
    normal = surface.normal(x, y)
    to_camera, to_point = kernels.minus(camera, crossing), kernels.minus(point, crossing)
    keep = (kernels.dot(to_camera, normal) > 0.0) & (kernels.dot(to_point, normal) < 0.0)
    keep &= surface.clear(camera, crossing, point)
    length = np.sqrt(kernels.dot(to_camera, to_camera)) + surface.n_water * np.sqrt(kernels.dot(to_point, to_point))
    owner, x, y, length = owner[keep], x[keep], y[keep], length[keep]
    order = np.lexsort((length, owner))
    first = order[np.unique(owner[order], return_index=True)[1]]
    best_x, best_y = np.full(unsettled.size, np.nan), np.full(unsettled.size, np.nan)
    best_x[owner[first]], best_y[owner[first]] = x[first], y[first]
    return best_x, best_y, np.where(unsettled, -1, np.bincount(owner, minlength=unsettled.size))


def _located(surface, camera, point, depth, bent):
    """Crossing x, y and number of paths in numpy; NaN and 0 where not bent."""
    x, y, count = np.full(depth.shape, np.nan), np.full(depth.shape, np.nan), np.zeros(depth.shape, dtype=np.int64)
    camera, point, depth = tuple(c[bent] for c in camera), tuple(p[bent] for p in point), depth[bent]
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what becomes NaN here is not proven below
        disc = search_disc(surface, camera, point, depth)
        found_x, found_y, settled = newton(surface, camera, point, disc)
        proven = disc.convex & settled
        paths = np.where(proven, 1, -1)
        if not proven.all():
            hard = tuple(tuple(c[~proven] for c in triple) for triple in (camera, point, disc[:3]))
            found_x[~proven], found_y[~proven], paths[~proven] = _least(surface, *hard[:2], Disc(*hard[2], None))
    x[bent], y[bent], count[bent] = found_x, found_y, paths
    return x, y, count


def _located_drjit(surface, camera, point, depth, bent):
    """`_located` with Dr.Jit arrays: a path that is not the only one for sure is not proven."""
    xp = namespace(depth)
    camera, point = (tuple(map(xp.fixed, end)) for end in _harmless(xp, surface, camera, point, bent))
    disc = search_disc(surface, camera, point, xp.fixed(xp.where(bent, depth, 1.0)))
    x, y, settled = newton(surface, camera, point, disc)
    return x, y, xp.where(disc.convex & settled, 1, -1)


def _harmless(xp, surface, camera, point, keep):
    """The ends of the paths to keep; for the others, ends above and below the anchor, where nothing can go wrong."""
    x, y = surface.anchor()
    z = float(surface.height(x, y))
    ends = ((camera, z + 1.0), (point, z - 1.0))
    return tuple(tuple(xp.where(keep, c, a) for c, a in zip(end, (x, y, zz), strict=True)) for end, zz in ends)


def crossing(surface: Relief, camera, point):
    """Where the camera sees the point through the surface: `refract.surfaces.WaterSurface.crossing`, in float64.

    Parameters
    ----------
    camera, point : triples of arrays [m], local

    Returns
    -------
    crossing : triple [m], local
        Of the path of least optical length; the point itself where the ray is straight (the point is not under the
        surface, or the camera not above it); NaN where there is no path, or where the search proved nothing.
    depth : [m]
        Of the point under the surface, vertical.
    solutions : whole numbers
        Stationary paths; 1 where the ray is straight, 0 where there is none, -1 where the number is not proven.

    Notes
    -----
    Torch tensors are solved by numpy. They and Dr.Jit arrays get their gradients from one Newton step at the root
    (the implicit function theorem); on a caustic, where the derivative is infinite, they get none.
    """
    camera, point = together(camera, point)
    xp = namespace(*point)
    depth = surface.height(point[0], point[1]) - point[2]
    bent = (depth > 0.0) & (camera[2] - surface.height(camera[0], camera[1]) > kernels.CONTACT)
    plain = surface.detached()
    if xp.name == "drjit":
        x, y, count = _located_drjit(plain, camera, point, depth, bent)
    else:
        ends = tuple(tuple(map(as_numpy, end)) for end in (camera, point))
        x, y, count = _located(plain, *ends, as_numpy(depth), as_numpy(bent) > 0.0)
    if xp.name == "torch":
        x, y, count = as_like(x, depth), as_like(y, depth), as_like(count, depth).long()
    found = bent & (count > 0)
    if xp.name != "numpy":
        x, y = _attached(xp, surface, camera, point, x, y, found)
    at = x, y, surface.height(x, y)
    seen = tuple(xp.where(found, a, xp.where(bent, math.nan, p)) for a, p in zip(at, point, strict=True))
    return seen, depth, xp.where(bent, count, 1)


def _attached(xp, surface, camera, point, x, y, found):
    """The crossing x, y with gradients with respect to everything: one Newton step with a fixed Hessian."""
    plain = surface.detached()
    camera, point = _harmless(xp, plain, camera, point, found)
    x, y = (xp.where(found, c, a) for c, a in zip((x, y), plain.anchor(), strict=True))
    gradient, hessian = path_slope(surface, camera, point, x, y)
    hxx, hxy, hyy = (xp.fixed(h) for h in hessian)
    firm = xp.abs(hxx * hyy - hxy * hxy) > _FIRM * (hxx * hxx + 2.0 * hxy * hxy + hyy * hyy)
    whole = zip((hxx, hxy, hyy), (1.0, 0.0, 1.0), strict=True)
    step_x, step_y = _step(gradient, tuple(xp.where(firm, h, one) for h, one in whole))
    return x + xp.where(firm, step_x, 0.0), y + xp.where(firm, step_y, 0.0)
