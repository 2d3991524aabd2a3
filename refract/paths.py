"""Rays bent at the water surface: from the camera down to the bed."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, final

from refract import kernels
from refract._array import common, components, namespace, quiet, spread, stack
from refract._numbers import in_library
from refract.snell import Regime, regime_counts
from refract.surfaces import FlatWater, WaterSurface, derivable, height_over, require_surface


@final
@dataclass(frozen=True)
class BentPaths:
    """Paths of rays from the camera through the water surface; arrays of the library of the rays, local frame."""

    origin: Any  # (..., 3) [m]: camera centre
    air_direction: Any  # (..., 3) unit
    crossing: Any  # (..., 3) [m]: where the ray meets the surface; NaN where it never does
    air_length: Any  # (...) [m]: from origin to crossing; infinite where the ray never meets the water
    # (..., 3) unit: direction after the crossing; equal to `air_direction` where the ray never meets the water, or
    # where the camera is below the surface
    water_direction: Any
    wet: Any  # (...) bool: the ray enters the water if nothing dry stops it first
    parallel: Any  # (...) bool: the ray never meets the water because it runs along the surface
    tide: float = 0.0  # [m]: how high the surface that bent the rays stands over the one that heights count from

    @property
    def regime(self):
        """`Regime` of each ray, (...) int."""
        xp = namespace(self.air_length)
        code = xp.where(self.wet, int(Regime.BENT), int(Regime.STRAIGHT))
        code = xp.where(self.parallel, int(Regime.PARALLEL), code)
        code = xp.where(self.air_length == 0.0, int(Regime.UNDER_WATER), code)
        code = xp.where(self.wet & xp.isnan(components(self.water_direction)[0]), int(Regime.REFLECTED), code)
        return xp.where(xp.isnan(self.air_length), int(Regime.INVALID), code)

    def regime_counts(self) -> dict[str, int]:
        """Number of rays of each `Regime`, by its name in lower case."""
        return regime_counts(self.regime)

    def raised(self, by: float) -> BentPaths:
        """The same paths with all places ``by`` [m] higher; heights keep their zero (numpy only).

        Undoes the shift by which camera and bed were lowered to a common water level.
        """
        up = (0.0, 0.0, by)
        return replace(self, origin=self.origin + up, crossing=self.crossing + up, tide=self.tide + by)

    @quiet
    def at(self, t):
        """Points (..., 3) [m] at path length ``t`` (...) [m] from the camera, air and water legs together.

        Raises ValueError if the shape of `t` does not broadcast against that of the rays.
        """
        t, air_length = common(t=t, rays=self.air_length)
        xp = namespace(air_length)
        legs = (components(v) for v in (self.origin, self.air_direction, self.water_direction))
        valid, (origin, air_direction, water_direction) = kernels.cleaned(*legs)
        in_air = (t <= air_length) | ~self.wet
        t_air = xp.where(in_air, t, air_length)
        crossing = kernels.point_at_distance(origin, air_direction, t_air)
        points = kernels.point_at_distance(crossing, water_direction, t - t_air)
        return stack(*kernels.chosen(valid, points, math.nan))

    def at_height(self, height, water: FlatWater | None):
        """Points (..., 3) [m] where the paths are ``height`` (...) [m] above the water plane.

        Heights are measured along the normal of the plane and negative below it. Both legs meet at height zero, so a
        hypothesis in height passes the shoreline without a step. Without water, ``height`` counts from local z = 0. NaN
        where the path never reaches that height: it lies behind the camera, or the ray runs along the surface. Raises
        ValueError if the shape of `height` does not broadcast against that of the rays.
        """
        if water is not None and not isinstance(water, FlatWater):
            raise TypeError(f"heights count from a plane: expected FlatWater or None, got {water}; use at(t)")
        height, _ = common(height=height, rays=self.air_length)
        xp = namespace(height)
        water = water if water is not None else FlatWater((0.0, 0.0, 0.0), n_water=1.0)
        valid = ~xp.isnan(self.air_length)
        rays = tuple(kernels.chosen(valid, components(v), 0.0) for v in (self.origin, self.air_direction))
        point, up, n_water = water.plane(*rays)
        point = point if self.tide == 0.0 else (*point[:2], point[2] + self.tide)
        origin, direction, point, up, (n_water,) = (kernels.double(v) for v in (*rays, point, up, (n_water,)))
        points = kernels.at_height(origin, direction, xp.double(height) - self.tide * up[2], point, up, n_water)
        return stack(*kernels.chosen(valid, tuple(xp.like(p, self.air_length) for p in points), math.nan))


@quiet
def trace(origin, direction, surface: WaterSurface | None) -> BentPaths:
    """Bend camera rays at the water surface.

    Raises ValueError if the last axis of `origin` or `direction` is not 3, or their shapes do not broadcast; TypeError
    if the surface is none.

    Parameters
    ----------
    origin, direction : (..., 3) numpy or torch; local [m] and unit
        Camera centres and directions of view; they broadcast.
    surface : WaterSurface or None
        None leaves every ray straight and dry.

    Returns
    -------
    BentPaths
        A ray that never meets the water (it looks up, or runs along the surface) is straight and not wet, and
        only its crossing is NaN. A camera on or below the surface looks straight through the water; it counts
        as wet, with a crossing at the camera. A direction whose length is not one (by more than 5e-6) is invalid. A
        single bad ray never raises; `BentPaths.regime_counts` reports it.
    """
    require_surface(surface)
    origin, direction = common(origin=origin, direction=direction)
    given = components(origin), components(direction)
    (o, d), xp = given, namespace(*given[0])
    valid = kernels.is_unit(d) & kernels.in_reach(o)
    if derivable(surface, *o, *d):
        # Through zeros, a ray that is not a number leaves the gradients of the others alone.
        o, d = kernels.chosen(valid, o, 0.0), kernels.chosen(valid, d, 0.0)
    straight = kernels.chosen(valid, given[1], math.nan)
    at, bent, reach = o, straight, o[0] * 0.0
    wet = parallel = valid & False
    if surface is not None:
        t = surface.intersect(o, d)
        below = valid & (height_over(surface, o) <= kernels.CONTACT)
        meets = valid & ~below & (t >= 0.0)
        wet = meets | below
        reach = kernels.selector(meets)(t, 0.0)
        at = kernels.point_at_distance(o, d, reach)
        normal, n_water = surface.normal(at[0], at[1]), in_library(surface.n_water, o[0])
        # Where a ray does not meet the surface there may be none: a level one has harmless derivatives.
        zero = reach * 0.0
        facing = normal if isinstance(surface, FlatWater) else kernels.chosen(meets, normal, (zero, zero, zero + 1.0))
        bent = kernels.chosen(meets, kernels.bend(d, facing, 1.0, n_water), straight)
        parallel = valid & ~wet & (xp.abs(kernels.dot(d, normal)) <= kernels.GRAZING)
    crossing = kernels.chosen(wet, at, math.nan)
    air_length = kernels.selector(valid)(kernels.selector(wet)(reach, math.inf), math.nan)
    return _paths(origin, direction, (crossing, air_length, bent), wet, parallel)


def _paths(origin, direction, refracted, wet, parallel) -> BentPaths:
    """Paths in the precision of the rays and in one shape; ``refracted`` is crossing, length in air, direction."""
    crossing, air_length, bent = refracted
    xp, like = namespace(air_length), components(direction)[0]
    air_length = xp.like(air_length, like)
    crossing, bent = (stack(*(xp.like(v, like) for v in c)) for c in (crossing, bent))
    air_length, wet, parallel = spread(air_length, wet, parallel, bent[..., 0])[:3]
    origin, direction, crossing, bent = spread(origin, direction, crossing, bent)
    return BentPaths(origin, direction, crossing, air_length, bent, wet, parallel)
