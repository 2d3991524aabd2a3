"""Rays through any smooth surface with known height and normal: tracing and projection by Newton's method.

Nothing is proven here: the intersection or path that Newton's method converges to is the answer; others are not
searched for. `refract.curved.wavy` and `refract.curved.fermat` find all, from bounds that a surface must provide.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

from refract import kernels
from refract._array import namespace, transformed
from refract._implicit import along_ray, newton_step, over_surface
from refract._solvers import solver
from refract.curved.fermat import together

# A step below this part of the ray length, or of the distance from camera to point, has converged.
_CONVERGED = 1e-12
# So has a step below the rounding of coordinates far from the origin: this many units in the last place.
_ROUNDING = 32 * 2.0**-52
# A calm sea takes four to six steps. What has not converged after this many is NaN.
_MOST_STEPS = 30
# Second derivatives are differences of normals over this part of that distance.
_APART = 1e-6
_PLANE_STEPS = 4


def _all(is_converged) -> bool:
    """Whether all have converged; False where that cannot be read before the end."""
    return namespace(is_converged).name != "drjit" and not transformed() and bool(is_converged.all())


def _size(position):
    """Sum of the absolute coordinates of a position [m]."""
    return sum(map(namespace(*position).abs, position))


class AnySurface(ABC):
    """A base for surfaces of which only height and normal are known: the rest of `WaterSurface` follows.

    For component arrays of numpy, torch and Dr.Jit, whatever `height` and `normal` take; gradients flow to all that
    they depend on. Where the surface has no height it must be NaN.

    Examples
    --------
    Water that stands in a bowl, 1 cm higher at 10 m from its middle:

    >>> import numpy as np
    >>> from refract import project
    >>> from refract.curved import AnySurface
    >>> class Bowl(AnySurface):
    ...     n_water = 1.333
    ...     def height(self, x, y):
    ...         return 1e-4 * (x * x + y * y)
    ...     def normal(self, x, y):
    ...         up = 1.0 / np.sqrt(1.0 + 4e-8 * (x * x + y * y))
    ...         return -2e-4 * x * up, -2e-4 * y * up, up
    >>> seen = project(np.array([8.0, 0.0, -3.0]), np.array([0.0, 0.0, 30.0]), Bowl())
    >>> [round(float(v), 4) for v in seen.crossing]
    [7.4464, 0.0, 0.0055]
    """

    n_water: Any

    @abstractmethod
    def height(self, x, y):
        """Height z of the surface at x, y."""

    @abstractmethod
    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the surface at x, y, pointing up into the air."""

    def intersect(self, origin, direction):
        """Distance [m] to an intersection along unit rays from above; NaN where Newton's method finds none."""
        like = origin[0] + direction[0]
        origin, direction = together(origin, direction)
        xp = namespace(*origin)

        t, is_converged = self._newton_distance(*(tuple(map(xp.fixed, v)) for v in (origin, direction)))
        meets = is_converged & (t >= 0.0)
        t = along_ray(lambda t: self._clearance(origin, direction, t), xp.where(meets, t, 0.0), meets)
        return xp.like(xp.where(meets, xp.maximum(t, 0.0), math.nan), like)

    def _clearance(self, origin, direction, t):
        """Height [m] of a ray above the surface at distance t, and its rate [-]."""
        x, y, z = kernels.point_at_distance(origin, direction, t)
        slope_x, slope_y = self._slopes(x, y)
        return z - self.height(x, y), direction[2] - slope_x * direction[0] - slope_y * direction[1]

    def _newton_distance(self, origin, direction):
        """Newton's method along rays, and its convergence; without derivatives."""
        xp = namespace(*origin)
        t, is_converged, rounding = origin[0] * 0.0, origin[0] < math.inf, _ROUNDING * _size(origin)
        for _ in range(_MOST_STEPS):
            over, rate = map(xp.fixed, self._clearance(origin, direction, t))
            falls = rate < -kernels.GRAZING
            rate_down = xp.where(falls, -rate, 1.0)
            move = over / rate_down
            is_converged = falls & (xp.abs(move) <= _CONVERGED * (1.0 + xp.abs(t)) + rounding / rate_down)
            t = xp.where(falls, t + move, t)
            if _all(is_converged):
                break
        return t, is_converged

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`; `num_paths` is 1 where the steps arrive at a path, else -1: not proven."""
        camera, point = together(camera, point)
        xp = namespace(*point)
        depth = self.height(point[0], point[1]) - point[2]
        over = camera[2] - self.height(camera[0], camera[1])
        # A camera where the surface has no height is over it; a point there is not under it.
        bent = (depth > 0.0) & ~(over <= kernels.CONTACT)
        above, below = (tuple(map(xp.fixed, end)) for end in self._harmless(camera, point, bent))
        x, y, is_converged = self._newton_crossing(above, below, xp.fixed(xp.where(bent, depth, 1.0)))
        found = bent & is_converged
        x, y = (xp.where(found, a, p) for a, p in zip((x, y), point[:2], strict=True))
        above, below = self._harmless(camera, point, found)
        matrix = self._matrix(above, below, x, y)
        x, y = over_surface(lambda x, y: self._gradient(above, below, x, y, found), matrix, x, y, found)
        at = x, y, self.height(x, y)
        seen = tuple(xp.where(found, a, xp.where(bent, math.nan, p)) for a, p in zip(at, point, strict=True))
        return seen, depth, xp.where(found | ~bent, 1, -1)

    def _harmless(self, camera, point, keep):
        """The ends of the paths to keep; elsewhere placeholders above and below the surface that give valid numbers."""
        xp = namespace(*point)
        z = xp.fixed(self.height(point[0], point[1]))
        z = xp.where(xp.isnan(z), 0.0, z)
        above, below = (tuple(map(xp.fixed, (*end[:2], z + side))) for end, side in ((camera, 1.0), (point, -1.0)))
        return kernels.chosen(keep, camera, above), kernels.chosen(keep, point, below)

    def _slopes(self, x, y):
        nx, ny, nz = self.normal(x, y)
        return -nx / nz, -ny / nz

    def _gradient(self, camera, point, x, y, keep=None):
        """Gradient of the optical length by x and y of the crossing; the surface counts as level where not ``keep``."""
        xp = namespace(x)
        z, (zx, zy) = self.height(x, y), self._slopes(x, y)
        if keep is not None:
            z, zx, zy = kernels.chosen(keep, (z, zx, zy), (point[2] + 1.0, 0.0, 0.0))
        gx = gy = 0.0
        for end, weight in ((camera, 1.0), (point, self.n_water)):
            dx, dy, dz = x - end[0], y - end[1], z - end[2]
            per_metre = weight / xp.sqrt(dx * dx + dy * dy + dz * dz)
            gx, gy = gx + (dx + zx * dz) * per_metre, gy + (dy + zy * dz) * per_metre
        return gx, gy

    def _matrix(self, camera, point, x, y):
        """Derivatives of `_gradient` by x and by y, from finite differences, without derivatives of their own."""
        xp = namespace(x)
        camera, point = (tuple(map(xp.fixed, end)) for end in (camera, point))
        chord = kernels.minus(camera, point)
        step = _APART * xp.sqrt(kernels.dot(chord, chord))
        rows = []
        for ax, ay in ((step, 0.0), (0.0, step)):
            forward, backward = (self._gradient(camera, point, x + sign * ax, y + sign * ay) for sign in (1.0, -1.0))
            rows.append(tuple(xp.fixed(p - q) / (2.0 * step) for p, q in zip(forward, backward, strict=True)))
        return rows

    def _newton_crossing(self, camera, point, depth):
        """Newton's method from the crossing of a level plane, and its convergence."""
        xp = namespace(*point)
        leg = kernels.minus(point, camera)
        square = leg[0] * leg[0] + leg[1] * leg[1]
        H = camera[2] - point[2] - depth
        share = kernels.air_share(square, xp.where(H > 0.0, H, 1.0), depth, xp.fixed(self.n_water), _PLANE_STEPS)
        x, y = camera[0] + share * leg[0], camera[1] + share * leg[1]
        chord = xp.sqrt(kernels.dot(leg, leg))
        is_converged, tolerance = chord < 0.0, _CONVERGED * chord + _ROUNDING * _size(camera)
        for _ in range(_MOST_STEPS):
            gradient, matrix = self._gradient(camera, point, x, y), self._matrix(camera, point, x, y)
            step_x, step_y = map(xp.fixed, newton_step(gradient, matrix))
            length = xp.sqrt(step_x * step_x + step_y * step_y)
            is_converged = length <= tolerance
            back = xp.where(length > depth, depth / xp.where(length > 0.0, length, 1.0), 1.0)
            x, y = x + back * step_x, y + back * step_y
            if _all(is_converged):
                break
        return x, y, is_converged


@solver(outputs=2)
def newton_distance(surface: AnySurface, *ends):
    """Intersection of rays (origins, directions) with the surface by Newton's method, and its convergence."""
    return surface._newton_distance(ends[:3], ends[3:])


@solver(outputs=3)
def newton_crossing(surface: AnySurface, *arrays):
    """Crossing x, y of the paths from cameras to points by Newton's method, and its convergence."""
    return surface._newton_crossing(arrays[:3], arrays[3:6], arrays[6])
