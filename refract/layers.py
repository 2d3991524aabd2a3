"""A stack of parallel flat interfaces: a housing port (air, glass, water), a pane, oil on water.

Along a path through parallel layers ``n_i sin(theta_i)`` is the same in every layer (Snell). So one number fixes the
whole path: here x, the tangent of the angle to the normal in the layer of least index, n_least. With
``m_i = n_i / n_least`` the tangent in layer i is ``x q_i``, ``q_i = 1 / sqrt(m_i^2 + (m_i^2 - 1) x^2)``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, final

import numpy as np

from refract import kernels
from refract._array import common, components, namespace, quiet, root, spread, stack
from refract._numbers import hold, least, moved, number, of_any_size
from refract.snell import Regime, regime_counts

# Newton's steps: 12 reach the last bits of float64 over indices 1 to 1.6, layers of 1 mm to 1 km and points to 100
# times as far aside (20 000 stacks); a housing takes 5.
_STEPS = 16
_NUMBERS = ("point", "normal", "indices", "thicknesses")


@final
@dataclass(frozen=True)
class LayeredPath:
    """Paths of rays through the stack; arrays of the library of the rays, in their frame."""

    origin: Any  # (..., 3) [m]: camera centre
    # tuple of (..., 3) [m]: where the ray passes each interface, from the camera's side; NaN from where it is turned
    # back
    crossings: tuple[Any, ...]
    directions: tuple[Any, ...]  # tuple of (..., 3) unit: in each medium; NaN where the ray never gets there
    # tuple of (...) [m]: in each medium but the last; infinite where the ray never reaches its end
    lengths: tuple[Any, ...]
    # (...) int: `Regime` of each ray: bent; straight where it leads away from the first interface, parallel along it;
    # reflected at any of them; invalid where a number is NaN or beyond 1e15 m, the direction not of length one, or the
    # origin not in the first medium
    regime: Any

    @property
    def direction(self):
        """Direction (..., 3), unit, in the last medium; NaN where the ray never gets there."""
        return self.directions[-1]

    @of_any_size
    @quiet
    def at(self, t):
        """Points (..., 3) [m] at path length ``t`` (...) [m] from the camera through all media.

        NaN behind the interface that turns a ray back.

        Raises
        ------
        ValueError
            If the shape of `t` does not broadcast against that of the rays.
        """
        t, _ = common(t=t, rays=self.lengths[0])
        xp, begin = namespace(t), 0.0
        valid, (origin, ray) = kernels.cleaned(components(self.origin), components(self.directions[0]))
        points = kernels.point_at_distance(origin, ray, t)
        for crossing, direction, length in zip(self.crossings, self.directions[1:], self.lengths, strict=True):
            begin = begin + length
            start, ray, past = components(crossing), components(direction), t > begin
            passes = past & ~xp.isnan(ray[0])
            start, ray = (kernels.chosen(passes, v, 0.0) for v in (start, ray))
            moved = kernels.point_at_distance(start, ray, xp.where(passes, t - begin, 0.0))
            points = kernels.chosen(past, kernels.chosen(passes, moved, math.nan), points)
        return stack(*kernels.chosen(valid, points, math.nan))

    def raised(self, by: float) -> LayeredPath:
        """The same paths with all places ``by`` [m] higher: see `refract.paths.BentPaths.raised`."""
        up = (0.0, 0.0, by)
        return replace(self, origin=self.origin + up, crossings=tuple(c + up for c in self.crossings))

    def regime_counts(self) -> dict[str, int]:
        """Number of rays of each `Regime`, by its name in lower case."""
        return regime_counts(self.regime)


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
        numbers = (*self.point, *self.normal, *self.indices, *self.thicknesses)
        if not hold(np.isfinite, *numbers) or not hold(lambda v: v > 0.0, kernels.dot(self.normal, self.normal)):
            raise ValueError(f"expected finite numbers and a normal with a length, got {self}")
        at_least = hold(lambda v: v >= 0.0, *self.thicknesses)
        if not at_least or not hold(lambda n: (n >= 1.0) & (n <= 2.5), *self.indices):
            raise ValueError(
                f"expected indices of 1 to 2.5 and thicknesses of at least zero, got {self.indices} and "
                f"{self.thicknesses}"
            )
        length = root(kernels.dot(self.normal, self.normal))
        object.__setattr__(self, "normal", tuple(c / length for c in self.normal))

    def to(self, *place, **options) -> ParallelLayers:
        """The same layers with their tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    @of_any_size
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
        valid = kernels.is_unit(ray) & kernels.in_reach(at)
        at, ray = kernels.chosen(valid, at, 0.0), kernels.chosen(valid, ray, 0.0)
        drop = kernels.height_over_plane(at, self.point, self.normal)
        valid = valid & (drop >= 0.0)
        active, crossings, lengths = valid, [], []
        directions = [stack(*kernels.chosen(valid, ray, math.nan))]
        regime = xp.where(kernels.dot(ray, self.normal) > 0.0, int(Regime.STRAIGHT), int(Regime.BENT))
        for place, (n_from, n_to) in enumerate(zip(self.indices, self.indices[1:], strict=False)):
            falling = -kernels.dot(ray, self.normal)
            if place == 0:
                regime = xp.where(xp.abs(falling) <= kernels.GRAZING, int(Regime.PARALLEL), regime)
            active = active & (falling > kernels.GRAZING)
            # Rays that go no farther get harmless numbers: their gradients are zero.
            length = drop / xp.where(active, falling, 1.0)
            at = kernels.point_at_distance(at, ray, xp.where(active, length, 0.0))
            lengths.append(xp.where(active, length, math.inf))
            crossings.append(stack(*kernels.chosen(active, at, math.nan)))
            bent = kernels.bend(ray, self.normal, n_from, n_to)
            passes = active & ~xp.isnan(bent[0])
            regime = xp.where(active & ~passes, int(Regime.REFLECTED), regime)
            active, ray = passes, kernels.chosen(passes, bent, ray)
            directions.append(stack(*kernels.chosen(active, ray, math.nan)))
            drop = self.thicknesses[place] if place < len(self.thicknesses) else 0.0
        regime = xp.where(valid, regime, int(Regime.INVALID))
        if xp.name != "drjit":
            origin = spread(origin, directions[0])[0]
        return LayeredPath(origin, tuple(crossings), tuple(directions), tuple(lengths), regime)

    @of_any_size
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
        (leg, _), depth = self.legs(components(camera), components(points))
        xp = namespace(depth)
        length = xp.sqrt(kernels.dot(leg, leg))
        seen = length > 0.0
        return stack(*kernels.chosen(seen, tuple(c / xp.where(seen, length, 1.0) for c in leg), math.nan))

    def legs(self, camera, point) -> tuple:
        """The first and the last leg from cameras to points, and the distance of the points from the last interface.

        Triples of arrays [m]; the legs are zero where `project` is NaN.
        """
        xp = namespace(*point)
        valid = kernels.in_reach(camera, point)
        camera, point = kernels.chosen(valid, camera, 0.0), kernels.chosen(valid, point, 0.0)
        H = kernels.height_over_plane(camera, self.point, self.normal)
        depth = -kernels.height_over_plane(point, self.point, self.normal) - sum(self.thicknesses)
        seen = valid & (H > 0.0) & (depth > 0.0)
        near, far = xp.where(seen, H, 1.0), xp.where(seen, depth, 1.0)
        along = kernels.tangential_part(kernels.minus(point, camera), self.normal)
        legs = (
            tuple(height * (slope * a - m) for a, m in zip(along, self.normal, strict=True))
            for height, slope in zip((near, far), self._slopes(kernels.dot(along, along), near, far), strict=True)
        )
        first, last = (kernels.chosen(seen, leg, 0.0) for leg in legs)
        return (first, last), xp.where(valid, depth, math.nan)

    def _slopes(self, D_squared, near, far):
        """Tangents to the normal in the first and the last medium over the distance D: smooth where D = 0.

        With ``v = x / D`` the condition is ``sum_i h_i v q_i = 1``, ``q_i`` taken at ``x = v D``. The left side rises
        and is concave, so Newton's steps from below never overshoot; ``q_i <= 1 / m_i`` gives the start.
        """
        xp = namespace(D_squared)
        thicknesses = (near, *self.thicknesses, far)
        m = [n / least(*self.indices) for n in self.indices]

        def root_of(k, v):
            return xp.sqrt(k * k + (k - 1.0) * (k + 1.0) * D_squared * v * v)

        v = 1.0 / sum(h / k for h, k in zip(thicknesses, m, strict=True))
        for _ in range(_STEPS):
            covered, slope = -1.0, 0.0
            for h, k in zip(thicknesses, m, strict=True):
                q = 1.0 / root_of(k, v)
                covered, slope = covered + h * v * q, slope + h * k * k * q * q * q
            v = v - covered / slope
        return v / root_of(m[0], v), v / root_of(m[-1], v)
