"""Projection through a curved surface z = f(x, y): all stationary optical paths, proven and counted (Fermat).

The path from camera C over a surface point S to a bed point P has the optical length |C - S| + n |S - P|; light
takes those S where it is stationary (Fermat). Three steps, each with a bound behind it:

1. No path that obeys Snell's law crosses outside a disc, which follows from bounds of the surface (range of height,
   slope, curvature), because slopes turn the refracted ray only so far (`refract.curved._disc`).
2. If the length is strictly convex over the disc, it holds exactly one path, and Newton's steps find it.
3. Elsewhere the disc is cut into boxes until interval arithmetic proves that each contains no path or exactly one
   (`refract.curved._branches`). What it cannot prove within its budget is NaN, with a count of -1.

Vectors are triples of component arrays (numpy, torch, Dr.Jit), as in `refract.kernels`.
"""

from __future__ import annotations

import math
from typing import Protocol

import numpy as np

from refract import kernels
from refract._array import namespace, transformed
from refract._implicit import newton_step, over_surface
from refract._numbers import read
from refract._solvers import solver
from refract.curved._branches import every_path
from refract.curved._disc import Bounds, Disc, hypot, search_disc
from refract.surfaces import WaterSurface

# Newton's last step, as part of the camera's distance: squared, it is far below the rounding.
_CONVERGED = 1e-11
# Newton's steps on a convex length take four or five; harder cases go to the full search.
_MOST_STEPS = 10
# A path is left without gradient where the determinant of its curvature falls below this part of the squared norm:
# it lies on a caustic, where the crossing moves infinitely fast. Grazing rays, too: 89.9 deg has 3e-6.
_LEAST_DETERMINANT = 1e-9


class SmoothSurface(WaterSurface, Protocol):
    """A smooth surface: what this module requires beyond `WaterSurface`."""

    def derivatives(self, x, y) -> tuple:
        """Height and derivatives (f, f_x, f_y, f_xx, f_xy, f_yy); also of an `Interval`."""

    def bounds(self, x, y, radius) -> Bounds:
        """Bounds over the disc of this radius [m] about x, y."""

    def clear(self, camera, crossing, point):
        """True where the legs to the crossing meet the surface nowhere else (numpy)."""

    def detached(self) -> SmoothSurface:
        """The same surface with plain numbers and without gradients."""

    def anchor(self) -> tuple:
        """Some x, y where the surface is defined, plain numbers."""


def together(*triples):
    """Triples in float64, all of their arrays of the same shape."""
    triples = tuple(map(kernels.double, triples))
    zero = sum(sum(triple) for triple in triples) * 0.0
    return tuple(tuple(c + zero for c in triple) for triple in triples)


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


def newton(surface, camera, point, disc):
    """Newton's steps from the middle of the disc, kept inside; returns x, y and True where they have converged."""
    xp = namespace(*camera, *point)
    chord = hypot(xp, hypot(xp, camera[0] - point[0], camera[1] - point[1]), camera[2] - point[2])
    x, y, converged = disc.x, disc.y, chord < 0.0
    for _ in range(_MOST_STEPS):
        gradient, (hxx, hxy, hyy) = path_slope(surface, camera, point, x, y)
        step_x, step_y = newton_step(gradient, ((hxx, hxy), (hxy, hyy)))
        converged = hypot(xp, step_x, step_y) <= _CONVERGED * chord
        out_x, out_y = x + step_x - disc.x, y + step_y - disc.y
        out = hypot(xp, out_x, out_y)
        back = xp.where(out > disc.radius, disc.radius / xp.where(out > 0.0, out, out * 0.0 + 1.0), out * 0.0 + 1.0)
        x, y = disc.x + back * out_x, disc.y + back * out_y
        if xp.name == "numpy" and converged.all():
            break
    return x, y, converged


def _shortest_of_all(surface, camera, point, disc):
    """Crossing of the shortest of all unobstructed paths (numpy), and their number; -1 where that is not proven."""
    owner, x, y, unproven = every_path(surface, path_slope, camera, point, disc)
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
    best_x, best_y = np.full(unproven.size, np.nan), np.full(unproven.size, np.nan)
    best_x[owner[first]], best_y[owner[first]] = x[first], y[first]
    return best_x, best_y, np.where(unproven, -1, np.bincount(owner, minlength=unproven.size))


@solver(outputs=3)
def located(surface, *arrays):
    """Crossing x, y and number of paths in numpy, of cameras, points, their depth and where they are bent.

    Eight arrays (...): three coordinates of each, the depth and a number that is not zero where bent; NaN, NaN and 0
    where it is zero.
    """
    *ends, depth, bent = arrays
    bent = bent != 0.0
    x, y, count = np.full(depth.shape, np.nan), np.full(depth.shape, np.nan), np.zeros(depth.shape, dtype=np.int64)
    *ends, depth = (array[bent] for array in (*ends, depth))
    camera, point = tuple(ends[:3]), tuple(ends[3:])
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):  # what becomes NaN here is not proven below
        disc = search_disc(surface, camera, point, depth)
        found_x, found_y, converged = newton(surface, camera, point, disc)
        proven = disc.convex & converged
        paths = np.where(proven, 1, -1)
        if not proven.all():
            hard = ~proven
            hard_camera, hard_point = (tuple(c[hard] for c in end) for end in (camera, point))
            hard_disc = Disc(disc.x[hard], disc.y[hard], disc.radius[hard], None)
            found_x[hard], found_y[hard], paths[hard] = _shortest_of_all(surface, hard_camera, hard_point, hard_disc)
    x[bent], y[bent], count[bent] = found_x, found_y, paths
    return x, y, count


def _located_drjit(surface, camera, point, depth, bent):
    """`located` with Dr.Jit arrays: a path counts as proven only where it is certainly the only one."""
    xp = namespace(depth)
    camera, point = (tuple(map(xp.fixed, end)) for end in _harmless(xp, surface, camera, point, bent))
    disc = search_disc(surface, camera, point, xp.fixed(xp.where(bent, depth, 1.0)))
    x, y, converged = newton(surface, camera, point, disc)
    return x, y, xp.where(disc.convex & converged, 1, -1)


def _harmless(xp, surface, camera, point, keep):
    """The ends of the paths to keep; for the others, placeholders above and below the anchor with valid results."""
    x, y, z = _anchor(xp, surface, point[0])
    ends = ((camera, z + 1.0), (point, z - 1.0))
    return tuple(tuple(xp.where(keep, c, a) for c, a in zip(end, (x, y, zz), strict=True)) for end, zz in ends)


def _anchor(xp, surface, like):
    """A place of the surface, without derivatives: plain numbers, or arrays where torch hides them."""
    if not transformed():
        plain = surface.detached()
        x, y = plain.anchor()
        return x, y, float(plain.height(x, y))
    x, y = (xp.fixed(like * 0.0 + v) for v in surface.point[:2])
    return x, y, xp.fixed(surface.height(x, y))


def crossing(surface: SmoothSurface, camera, point):
    """Crossing of the ray from a camera to a point: `refract.surfaces.WaterSurface.crossing`, in float64.

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
    num_paths : whole numbers
        Stationary paths; 1 where the ray is straight, 0 where there is none, -1 where the number is not proven.

    Notes
    -----
    Torch tensors are solved by numpy. They and Dr.Jit arrays get their derivatives from Newton's steps at the root
    (the implicit function theorem): torch the first two, Dr.Jit the first; on a caustic, where the derivative is
    infinite, they get none.
    """
    camera, point = together(camera, point)
    xp = namespace(*point)
    depth = surface.height(point[0], point[1]) - point[2]
    bent = (depth > 0.0) & (camera[2] - surface.height(camera[0], camera[1]) > kernels.CONTACT)
    if xp.name == "drjit":
        x, y, count = _located_drjit(surface.detached(), camera, point, depth, bent)
    else:
        x, y, count = read(located, surface, (*camera, *point, depth, xp.like(bent, depth)))
        count = xp.integer(count)
    found = bent & (count > 0)
    if xp.name != "numpy":
        x, y = _attached(surface, camera, point, (x, y), found)
    at = x, y, surface.height(x, y)
    seen = tuple(xp.where(found, a, xp.where(bent, math.nan, p)) for a, p in zip(at, point, strict=True))
    return seen, depth, xp.where(bent, count, 1)


def _attached(surface, camera, point, crossing, found):
    """The crossing (x, y) with derivatives with respect to everything."""
    xp = namespace(*point)
    # By the point, since x is not a number where no path is found.
    anchor = _anchor(xp, surface, point[0])[:2]
    camera, point = _harmless(xp, surface, camera, point, found)
    x, y = (xp.where(found, c, a) for c, a in zip(crossing, anchor, strict=True))
    _, (hxx, hxy, hyy) = path_slope(surface, camera, point, x, y)
    is_regular = xp.abs(hxx * hyy - hxy * hxy) > _LEAST_DETERMINANT * (hxx * hxx + 2.0 * hxy * hxy + hyy * hyy)

    def gradient(x, y):
        return path_slope(surface, camera, point, x, y)[0]

    return over_surface(gradient, ((hxx, hxy), (hxy, hyy)), x, y, is_regular)
