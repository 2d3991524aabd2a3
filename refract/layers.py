"""A stack of parallel flat interfaces: a housing port (air, glass, water), a pane, oil on water.

Along a path through parallel layers ``n_i sin(theta_i)`` is the same in every layer (Snell). So one number fixes the
whole path: here x, the tangent of the angle to the normal in the layer of least index, n_least. With
``m_i = n_i / n_least`` the tangent in layer i is ``x q_i``, ``q_i = 1 / sqrt(m_i^2 + (m_i^2 - 1) x^2)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from refract import kernels
from refract._array import common, components, namespace, root, stack
from refract._numbers import moved, number, plain, values

# Newton's steps: 12 reach the last bits of float64 over indices 1 to 1.6, layers of 1 mm to 1 km and points to 100
# times as far aside (20 000 stacks); a housing takes 5.
_STEPS = 16
_NUMBERS = ("point", "normal", "indices", "thicknesses")


@final
@dataclass(frozen=True)
class LayeredPath:
    """Paths of rays through the stack; arrays of the library of the rays, in their frame.

    Attributes
    ----------
    crossings : tuple of (..., 3) [m]
        Where the ray passes each interface, from the camera's side; NaN from where it is turned back.
    direction : (..., 3) unit
        In the last layer; NaN where the ray never gets there.
    """

    crossings: tuple[Any, ...]
    direction: Any


@final
@dataclass(frozen=True)
class ParallelLayers:
    """Parallel plane interfaces between media, any one frame; numbers may be 0-d tensors.

    Parameters
    ----------
    point : (3,) [m]
        Any point of the first interface, the one next to the camera.
    normal : (3,)
        Across the layers, toward the camera; of any length.
    indices : (layers,)
        Refractive index of each medium, from the camera's to the last, all relative to the same one.
    thicknesses : (layers - 2,) [m]
        Of the layers between the first interface and the last; at least zero.

    Raises
    ------
    ValueError
        If there are less than two media, the numbers do not fit, an index is below 1 or above 2.5, a thickness is
        negative, the normal has no length, or a number is not finite.

    Examples
    --------
    A flat port 10 mm thick, 30 mm before the camera, which looks along z:

    >>> import numpy as np
    >>> port = ParallelLayers((0, 0, 0.03), (0, 0, -1), (1.0, 1.5, 1.34), (0.01,))
    >>> path = port.trace(np.zeros(3), np.array([0.6, 0.0, 0.8]))
    >>> [round(float(v), 6) for v in path.crossings[1]]
    [0.026864, 0.0, 0.04]
    """

    point: tuple[Any, Any, Any]
    normal: tuple[Any, Any, Any]
    indices: tuple[Any, ...]
    thicknesses: tuple[Any, ...] = ()

    def __post_init__(self):
        for name in _NUMBERS:
            object.__setattr__(self, name, tuple(number(v) for v in getattr(self, name)))
        sizes = tuple(len(getattr(self, name)) for name in _NUMBERS)
        if sizes[:2] != (3, 3) or sizes[2] < 2 or sizes[3] != sizes[2] - 2:
            raise ValueError(
                f"expected a point (3,), a normal (3,), indices (layers,) of two media or more and thicknesses "
                f"(layers - 2,), got {sizes} numbers"
            )
        point, normal, indices, thicknesses = (values(*getattr(self, name)) for name in _NUMBERS)
        if not np.isfinite([*point, *normal, *indices, *thicknesses]).all() or (normal.size and not normal.any()):
            raise ValueError(f"expected finite numbers and a normal with a length, got {self}")
        if not ((indices >= 1.0) & (indices <= 2.5)).all() or (thicknesses < 0.0).any():
            raise ValueError(
                f"expected indices of 1 to 2.5 and thicknesses of at least zero, got {indices} and {thicknesses}"
            )
        length = root(kernels.dot(self.normal, self.normal))
        object.__setattr__(self, "normal", tuple(c / length for c in self.normal))

    def to(self, *place, **options) -> ParallelLayers:
        """The same layers with their tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    def trace(self, origin, direction) -> LayeredPath:
        """Bend rays at every interface.

        Parameters
        ----------
        origin, direction : (..., 3) [m] and unit
            Camera centres in the first medium, and directions of view; they broadcast.

        Returns
        -------
        LayeredPath
            Equal indices leave the direction as it is, to the last bit.

        Raises
        ------
        ValueError
            If the last axis of `origin` or `direction` is not 3, or their shapes do not broadcast.
        """
        origin, direction = common(origin=origin, direction=direction)
        at, ray = components(origin), components(direction)
        xp = namespace(*at)
        way = kernels.dot(kernels.minus(at, self.point), self.normal)
        crossings = []
        for place, (n_from, n_to) in enumerate(zip(self.indices, self.indices[1:], strict=False)):
            falling = -kernels.dot(ray, self.normal)
            meets = (falling > kernels.GRAZING) & (way >= 0.0)
            t = xp.where(meets, way / xp.where(meets, falling, 1.0), math.nan)
            at = kernels.along(at, ray, t)
            crossings.append(stack(*at))
            bent = kernels.bend(ray, self.normal, n_from, n_to)
            ray = tuple(xp.where(meets, b, math.nan) for b in bent)
            way = falling * 0.0 + (self.thicknesses[place] if place < len(self.thicknesses) else 0.0)
        return LayeredPath(tuple(crossings), stack(*ray))

    def project(self, points, camera):
        """Directions (..., 3), unit, in which a camera in the first medium sees points in the last one.

        Parameters
        ----------
        points, camera : (..., 3) [m]
            They broadcast.

        Returns
        -------
        (..., 3) unit
            NaN where the point does not lie behind the last interface, or the camera not before the first. There is
            one path at most, since the way covered grows with the angle.

        Raises
        ------
        ValueError
            If the last axis of `points` or `camera` is not 3, or their shapes do not broadcast.
        """
        points, camera = common(points=points, camera=camera)
        point, centre = components(points), components(camera)
        xp = namespace(*point)
        H = kernels.dot(kernels.minus(centre, self.point), self.normal)
        depth = -kernels.dot(kernels.minus(point, self.point), self.normal)
        rest = depth - sum(self.thicknesses)
        seen = (H > 0.0) & (rest > 0.0)
        H, rest = xp.where(seen, H, 1.0), xp.where(seen, rest, 1.0)
        across = kernels.minus(point, centre)
        down = kernels.dot(across, self.normal)
        along = tuple(a - down * m for a, m in zip(across, self.normal, strict=True))
        slope = self._tangent(kernels.dot(along, along), (H, *self.thicknesses, rest))
        # The first leg descends H and advances `slope` along the layers per metre of descent.
        leg = tuple(slope * a - m for a, m in zip(along, self.normal, strict=True))
        length = xp.sqrt(kernels.dot(leg, leg))
        return stack(*(xp.where(seen, c / length, math.nan) for c in leg))

    def _tangent(self, D_squared, thicknesses):
        """Tangent to the normal in the first medium, over the distance D along the layers: smooth where D = 0.

        With ``v = x / D`` the condition is ``sum_i h_i v q_i = 1``, ``q_i`` taken at ``x = v D``. The left side rises
        and is concave, so Newton's steps from below never overshoot; ``q_i <= 1 / m_i`` gives the start.
        """
        xp = namespace(D_squared)
        n_least = min(self.indices, key=plain)
        m = [n / n_least for n in self.indices]
        v = 1.0 / sum(h / k for h, k in zip(thicknesses, m, strict=True))
        for _ in range(_STEPS):
            covered, slope = -1.0, 0.0
            for h, k in zip(thicknesses, m, strict=True):
                q = 1.0 / xp.sqrt(k * k + (k - 1.0) * (k + 1.0) * D_squared * v * v)
                covered, slope = covered + h * v * q, slope + h * k * k * q * q * q
            v = v - covered / slope
        first = m[0]
        return v / xp.sqrt(first * first + (first - 1.0) * (first + 1.0) * D_squared * v * v)
