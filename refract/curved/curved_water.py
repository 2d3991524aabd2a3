"""Water of known height and gradient: rays down to it and paths up through it, by Newton's method in a bracket.

Down, the height of a ray over the surface has a root at a crossing. Between the last distance above the surface and the
first one below it, Newton's steps are taken where they stay inside, bisections elsewhere. A surface that bounds its
curvature shortens the steps to the root of a parabola below that height, so that none passes the first crossing.

Up, light takes a crossing S at which the optical length |C - S| + n |S - P| is least (Fermat). From the crossing of a
level plane, Newton's steps are taken where they shorten the length, and a part of them elsewhere.

Vectors are triples of component arrays (numpy, torch), as in `refract.kernels`. Both solvers work without
derivatives; Newton's steps at the root attach these (the implicit function theorem): each step makes one more order
exact, the first two in torch.
"""

import math
from abc import ABC, abstractmethod
from typing import Any

from refract import kernels
from refract._array import in_blocks, namespace, quiet, transformed

# A step below this part of the distance, and of the coordinates, has reached their rounding.
_TINY, _ROUNDING = 4 * 2.0**-52, 32 * 2.0**-52
# Steps along a ray: 4 to 8 are usual, some 40 at 89.9 deg to the vertical over waves of slope 0.3, and 130 at worst. A
# ray that needs the most runs along the surface.
_MOST_STEPS = 10_000
_MOST_STEPS_UP = 40  # Steps up: four to six are usual. What has not converged after the most is NaN
_BLIND_STEPS = 30  # Steps of either kind where no value can be read to end them (transforms of torch)
# Newton's last step up, as part of the distance from camera to point: squared, it is far below the rounding.
_CONVERGED = 1e-11
_SHORTER = 4.0  # A step up that lengthens the path is divided by this
# Least curvature of the optical length, as part of its largest, that counts as a minimum; and of a path with
# derivatives: on a caustic the crossing moves infinitely fast. Grazing rays at 89.9 deg have a determinant of 3e-6.
_LEAST_CURVATURE, _LEAST_DETERMINANT = 1e-9, 1e-9
# At a saddle of the length its negative curvature is taken as positive, and at least as this part of the largest.
_SADDLE = 1e-3
_GRAZING = 1e-9  # A ray that approaches the surface by less than this per metre where it meets it gets no gradient
# Second derivatives are differences of gradients this far apart [m].
_APART = 1e-5
_PLANE_STEPS = 4


class CurvedWater(ABC):
    """A base for surfaces of which height and gradient are known: the rest of `WaterSurface` follows.

    For component arrays of numpy and torch, whatever `height` and `gradient` take; derivatives flow to all that
    they depend on. Where the surface ends they must be NaN.

    Examples
    --------
    Water that stands in a bowl, 1 cm higher at 10 m from its middle:

    >>> import numpy as np
    >>> from refract import project
    >>> from refract.curved import CurvedWater
    >>> class Bowl(CurvedWater):
    ...     n_water = 1.333
    ...     def height(self, x, y):
    ...         return 1e-4 * (x * x + y * y)
    ...     def gradient(self, x, y):
    ...         return 2e-4 * x, 2e-4 * y
    >>> seen = project(np.array([8.0, 0.0, -3.0]), np.array([0.0, 0.0, 30.0]), Bowl())
    >>> [round(float(v), 4) for v in seen.crossing]
    [7.4464, 0.0, 0.0055]
    """

    n_water: Any  # [-]: refractive index of the water relative to the air above it

    @abstractmethod
    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]."""

    @abstractmethod
    def gradient(self, x, y) -> tuple[Any, Any]:
        """Slopes of the surface along x and y [-] at local x, y [m]."""

    def hessian(self, x, y) -> tuple[Any, Any, Any]:
        """Second derivatives xx, xy, yy of the height [1/m]; by differences of the gradient, if not known better."""
        (xx, xy), (_, yy) = (
            tuple(
                (b - a) / (2.0 * _APART)
                for a, b in zip(self.gradient(x - dx, y - dy), self.gradient(x + dx, y + dy), strict=True)
            )
            for dx, dy in ((_APART, 0.0), (0.0, _APART))
        )
        return xx, xy, yy

    def curvature(self, dx, dy) -> Any:
        """A bound of the second derivative of the height [1/m] along (dx, dy); zero where none is known.

        With a bound the first crossing of a ray is found, without one that of rays steeper than the surface.
        """
        return 0.0

    def span(self, origin, direction) -> tuple[Any, Any]:
        """Distances [m] along rays before which and beyond which they do not meet the surface; NaN if never."""
        return 0.0, math.inf

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the surface at x, y, pointing up into the air."""
        zx, zy = self.gradient(x, y)
        up = 1.0 / namespace(zx).sqrt(1.0 + zx * zx + zy * zy)
        return -zx * up, -zy * up, up

    @quiet
    def intersect(self, origin, direction):
        """Distance [m] to the first crossing along unit rays from above; NaN where there is none."""
        like = origin[0] + direction[0]
        origin, direction = _in_double(origin, direction)
        xp = namespace(*origin)
        t, meets = _solved(self._first_crossing, *origin, *direction)
        t = xp.where(meets, t, 0.0)
        over, rate = self._clearance(origin, direction, t)
        is_regular = meets & (rate < -_GRAZING)
        slope = xp.fixed(xp.where(is_regular, rate, -1.0))
        for order in range(xp.orders):
            over = over if order == 0 else self._clearance(origin, direction, t)[0]
            t = t - xp.where(is_regular, over, 0.0) / slope
        return xp.like(xp.where(meets, xp.maximum(t, 0.0), math.nan), like)

    def _clearance(self, origin, direction, t):
        """Height [m] of a ray above the surface at distance t, and its rate [-]."""
        x, y, z = kernels.point_at_distance(origin, direction, t)
        zx, zy = self.gradient(x, y)
        return z - self.height(x, y), direction[2] - zx * direction[0] - zy * direction[1]

    def _first_crossing(self, *ends):
        """Distance to the first crossing along rays (origin x, y, z, direction x, y, z), and whether there is one."""
        origin, direction = ends[:3], ends[3:]
        xp, zero = namespace(*origin), origin[0] * 0.0
        low, end = (v + zero for v in self.span(origin, direction))
        bend, high, t = xp.fixed(self.curvature(*direction[:2]) + zero), zero + math.inf, low
        rounding = _ROUNDING * _size(origin)
        over, rate = map(xp.fixed, self._clearance(origin, direction, t))
        # A ray that is below the surface where it ends is not from above.
        active = (over >= -rounding) & (t <= end)
        met = active & False
        for _ in range(_BLIND_STEPS if transformed() else _MOST_STEPS):
            is_above = over > 0.0
            low, high = xp.where(is_above, t, low), xp.where(is_above, high, t)
            root = xp.sqrt(rate * rate + 2.0 * bend * xp.maximum(over, zero))
            ahead = xp.where(rate < 0.0, 2.0 * over / (root - rate), (rate + root) / bend)
            move = xp.where(is_above, ahead, -over / rate)
            following = xp.minimum(t + move, end)
            is_inside = (following > low) & (following < high)
            following = xp.where(is_inside, following, 0.5 * (low + high))
            arrived = active & ((xp.abs(move) <= _TINY * t) | (high - low <= _TINY * t + rounding))
            met = met | arrived
            active = active & ~arrived & (following < math.inf) & ~(is_above & (t >= end))
            if xp.none(active):
                break
            t = xp.where(active, following, t)
            over, rate = map(xp.fixed, self._clearance(origin, direction, t))
        return t, met

    @quiet
    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`; NaN where no path is found. In float64."""
        camera, point = _in_double(camera, point)
        xp = namespace(*point)
        depth = self.height(point[0], point[1]) - point[2]
        over = camera[2] - self.height(camera[0], camera[1])
        # A camera where the surface has no height is over it; a point there is not under it.
        bent = (depth > 0.0) & ~(over <= kernels.CONTACT)
        above, below = self._harmless(camera, point, bent)
        x, y, is_converged = _solved(self._least_path, *above, *below, xp.where(bent, depth, 1.0))
        found = bent & is_converged
        x, y = (xp.where(found, a, xp.fixed(p)) for a, p in zip((x, y), point[:2], strict=True))
        above, below = self._harmless(camera, point, found)
        x, y = self._with_derivatives(above, below, x, y, found)
        at = x, y, self.height(x, y)
        return tuple(xp.where(found, a, xp.where(bent, math.nan, p)) for a, p in zip(at, point, strict=True)), depth

    def _harmless(self, camera, point, keep):
        """The ends of the paths to keep; elsewhere placeholders above and below the surface that give valid numbers."""
        xp = namespace(*point)
        z = xp.fixed(self.height(point[0], point[1]))
        z = xp.where(xp.isnan(z), 0.0, z)
        above, below = (tuple(map(xp.fixed, (*end[:2], z + side))) for end, side in ((camera, 1.0), (point, -1.0)))
        return kernels.chosen(keep, camera, above), kernels.chosen(keep, point, below)

    def _length(self, camera, point, x, y, keep=None):
        """Optical length by way of x, y, and its gradient; the surface counts as level where not ``keep``.

        With unit vectors u from both ends to S and tangents e = (1, 0, z_x) and e' = (0, 1, z_y), each leg adds
        ``weight u . e`` to the gradient.
        """
        xp = namespace(x)
        z, (zx, zy) = self.height(x, y), self.gradient(x, y)
        if keep is not None:
            z, zx, zy = kernels.chosen(keep, (z, zx, zy), (point[2] + 1.0, 0.0, 0.0))
        total, gx, gy, legs = 0.0, 0.0, 0.0, []
        for end, weight in ((camera, 1.0), (point, self.n_water)):
            dx, dy, dz = x - end[0], y - end[1], z - end[2]
            length = xp.sqrt(dx * dx + dy * dy + dz * dz)
            along_x, along_y, up = (dx + zx * dz) / length, (dy + zy * dz) / length, dz / length
            total, gx, gy = total + weight * length, gx + weight * along_x, gy + weight * along_y
            legs.append((weight / length, weight * up, along_x, along_y))
        return total, (gx, gy), (zx, zy, legs)

    def _curvature_of_length(self, x, y, of_legs):
        """Hessian (xx, xy, yy) of the optical length, without derivatives, from what `_length` says of the legs.

        Each leg adds ``weight ((e . e' - (u . e) (u . e')) / length + u_z z_xy)``.
        """
        xp, (zx, zy, legs), second = namespace(x), of_legs, self.hessian(x, y)
        hxx = hxy = hyy = 0.0
        for stiff, lift, along_x, along_y in legs:
            hxx = hxx + stiff * (1.0 + zx * zx - along_x * along_x) + lift * second[0]
            hxy = hxy + stiff * (zx * zy - along_x * along_y) + lift * second[1]
            hyy = hyy + stiff * (1.0 + zy * zy - along_y * along_y) + lift * second[2]
        return tuple(map(xp.fixed, (hxx, hxy, hyy)))

    def _least_path(self, *arrays):
        """Crossing x, y of the path of least length near that through a level plane, and whether it converged.

        Of cameras (x, y, z), points (x, y, z) and the depths of these.
        """
        camera, point, depth = arrays[:3], arrays[3:6], arrays[6]
        xp = namespace(*point)
        leg = kernels.minus(point, camera)
        square = leg[0] * leg[0] + leg[1] * leg[1]
        H = camera[2] - point[2] - depth
        share = kernels.air_share(square, xp.where(H > 0.0, H, 1.0), depth, xp.fixed(self.n_water), _PLANE_STEPS)
        x, y = camera[0] + share * leg[0], camera[1] + share * leg[1]
        tolerance = _CONVERGED * xp.sqrt(kernels.dot(leg, leg)) + _ROUNDING * _size(camera)
        length, gradient, of_legs = self._length(camera, point, x, y)
        length, gradient = xp.fixed(length), tuple(map(xp.fixed, gradient))
        part, is_converged = depth * 0.0 + 1.0, depth < 0.0
        hessian = self._curvature_of_length(x, y, of_legs)
        for _ in range(_BLIND_STEPS if transformed() else _MOST_STEPS_UP):
            step_x, step_y = _newton_step(gradient, _convex(hessian))
            size = xp.sqrt(step_x * step_x + step_y * step_y)
            is_converged = is_converged | (size <= tolerance)
            if xp.none(~is_converged):
                break
            back = part * xp.where(size > depth, depth / xp.where(size > 0.0, size, 1.0), 1.0)
            new_x, new_y = x + back * step_x, y + back * step_y
            new_length, new_gradient, of_legs = self._length(camera, point, new_x, new_y)
            new_length = xp.fixed(new_length)
            new = new_x, new_y, new_length, *map(xp.fixed, new_gradient)
            new += self._curvature_of_length(new_x, new_y, of_legs)
            # A converged step does not shorten the path by more than its rounding.
            is_shorter = new_length <= length * (1.0 + _ROUNDING)
            old = x, y, length, *gradient, *hessian
            x, y, length, *rest = (xp.where(is_shorter, b, a) for a, b in zip(old, new, strict=True))
            gradient, hessian = tuple(rest[:2]), tuple(rest[2:])
            part = xp.where(is_shorter, 1.0, part / _SHORTER)
        return x, y, is_converged

    def _with_derivatives(self, camera, point, x, y, found):
        """The crossing with derivatives with respect to everything: Newton's steps at the root."""
        xp = namespace(x)
        _, gradient, of_legs = self._length(camera, point, x, y, found)
        hxx, hxy, hyy = self._curvature_of_length(x, y, of_legs)
        squares = hxx * hxx + 2.0 * hxy * hxy + hyy * hyy
        is_regular = found & (hxx * hyy - hxy * hxy > _LEAST_DETERMINANT * squares)
        matrix = tuple(xp.where(is_regular, h, unit) for h, unit in zip((hxx, hxy, hyy), (1.0, 0.0, 1.0), strict=True))
        # Differences in place of second derivatives are off by 1e-9 of them: one more step leaves nothing of it.
        is_difference = type(self).hessian is CurvedWater.hessian
        for order in range(xp.orders + is_difference):
            if order > 0:
                _, gradient, _ = self._length(camera, point, x, y, found)
            step_x, step_y = _newton_step(gradient, matrix)
            x, y = x + xp.where(is_regular, step_x, 0.0), y + xp.where(is_regular, step_y, 0.0)
        return x, y


def _solved(solver, *arrays):
    """What a solver finds for arrays, without derivatives."""
    xp = namespace(*arrays)
    arrays = tuple(map(xp.fixed, arrays))
    return in_blocks(solver, *arrays) if xp.name == "numpy" else solver(*arrays)


def _in_double(*triples):
    """Triples in float64, all of their arrays of the same shape."""
    triples = tuple(map(kernels.double, triples))
    zero = sum(sum(triple) for triple in triples) * 0.0
    return tuple(tuple(c + zero for c in triple) for triple in triples)


def _size(position):
    """Sum of the absolute coordinates of a position [m]."""
    return sum(map(namespace(*position).abs, position))


def _convex(hessian):
    """A Hessian (xx, xy, yy) made positive definite where it is not, so that Newton's step descends."""
    hxx, hxy, hyy = hessian
    xp = namespace(hxx)
    mean, spread = 0.5 * (hxx + hyy), xp.sqrt(0.25 * (hxx - hyy) * (hxx - hyy) + hxy * hxy)
    least, most = mean - spread, xp.abs(mean) + spread
    shift = xp.where(least > _LEAST_CURVATURE * most, 0.0, 2.0 * xp.abs(least) + _SADDLE * most)
    return hxx + shift, hxy, hyy + shift


def _newton_step(gradient, hessian):
    """Newton's step to the root of a gradient (x, y)."""
    (gx, gy), (hxx, hxy, hyy) = gradient, hessian
    determinant = hxx * hyy - hxy * hxy
    return (hxy * gy - hyy * gx) / determinant, (hxy * gx - hxx * gy) / determinant
