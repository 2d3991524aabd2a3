"""Rays bent at the water surface: from the camera down to the bed, and from points of the bed up to it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, final

from refract import kernels
from refract._array import common, components, in_library, namespace, quiet, spread, stack
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
    tide: float = 0.0  # [m]: how high the surface that bent the rays stands over the one that heights count from

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
        single bad ray never raises.
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
    wet = valid & False
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
    crossing = kernels.chosen(wet, at, math.nan)
    air_length = kernels.selector(valid)(kernels.selector(wet)(reach, math.inf), math.nan)
    # In the precision of the rays and in one shape.
    like = given[1][0]
    air_length = xp.like(air_length, like)
    crossing, bent = (stack(*(xp.like(v, like) for v in c)) for c in (crossing, bent))
    air_length, wet = spread(air_length, wet, bent[..., 0])[:2]
    origin, direction, crossing, bent = spread(origin, direction, crossing, bent)
    return BentPaths(origin, direction, crossing, air_length, bent, wet)


# Steps of a solver: more than any surface needs for full float64; a plane takes four at most (docs/optics.md).
EXACT_STEPS = 16

# Squared length below which a leg counts as zero [m^2]: derivatives of the length of a shorter one overflow.
_NO_LEG = 1e-200


@final
@dataclass(frozen=True)
class Projection:
    """Projection of points through the water; arrays of the library and precision of the points, local frame."""

    direction: Any  # (..., 3) unit: from the camera toward where the point appears; NaN where it cannot be seen
    # (...) [m]: of the point below the surface, along the normal of a plane, vertical for a curved surface; zero
    # without water
    depth: Any
    wet: Any  # (...) bool: the point is below the surface
    crossing: Any  # (..., 3) [m]: where the ray meets the surface; the point itself where the ray is straight
    # (...) [m]: of the two legs; a straight ray is all air, or, from a camera under water to a wet point, all water
    air_length: Any
    water_length: Any


def _measured(leg):
    """Length of a leg, zero without gradient where there is none, one over it, or one, and whether there is one."""
    xp = namespace(*leg)
    squared = kernels.dot(leg, leg)
    is_leg = ~(squared < _NO_LEG)
    inverse = xp.rsqrt(xp.where(is_leg, squared, 1.0))
    return xp.where(is_leg, squared * inverse, 0.0), inverse, is_leg


def _stacked(keep, triple, like):
    """Vectors in the precision of `like`, NaN where they are not to be kept."""
    xp = namespace(keep)
    return stack(*kernels.chosen(keep, tuple(xp.like(v, like) for v in triple), math.nan))


@quiet
def project(points, camera, surface: WaterSurface | None, *, steps: int = EXACT_STEPS) -> Projection:
    """Projection of points of the bed into a camera: the least optical path (Fermat) through the surface.

    Points and camera in float32 are computed in float64 where digits would be lost, and rounded once at the end. Raises
    ValueError if the last axis of `points` or `camera` is not 3, or their shapes do not broadcast; TypeError if the
    surface is none.

    Parameters
    ----------
    points : (..., 3) [m], local; numpy or torch
    camera : (3,) or (..., 3) [m], local
        Camera centre.
    surface : WaterSurface or None
        None: there is no water, and every ray is straight.
    steps : int
        Steps that the solver of the surface may take; fewer are faster (docs/optics.md).

    Returns
    -------
    Projection
        Rays to points above the water or beside it, from a camera on or below it, and without water are straight. A
        point that is NaN, farther out than 1e15 m, or in the camera, has a direction of NaN, and a single bad ray never
        raises.
    """
    require_surface(surface)
    points, camera = common(points=points, camera=camera)
    point, centre = components(points), components(camera)
    valid, point, centre = _ends(point, centre, surface)
    legs, depth, below = _legs(point, centre, surface, steps)
    xp = namespace(depth)
    wet, below = valid & (depth > 0.0), valid & below
    (air, inverse, is_leg), (water, _, _) = map(_measured, legs)
    direction = _stacked(valid & is_leg, tuple(c * inverse for c in legs[0]), point[0])
    crossing = _stacked(valid, kernels.minus(kernels.double(point), legs[1]), point[0])
    sunk = wet & below
    numbers = depth, xp.where(sunk, 0.0, air), xp.where(sunk, air, water)
    depth, air, water = (xp.where(valid, xp.like(v, point[0]), math.nan) for v in numbers)
    depth, wet, air, water, _ = spread(depth, wet, air, water, direction[..., 0])
    return Projection(direction, depth, wet, crossing, air, water)


def _ends(point, centre, surface):
    """Mask of valid ends, and the ends, with zeros elsewhere if gradients or the surface require it."""
    valid = kernels.in_reach(point, centre)
    if derivable(surface, *point, *centre):
        point, centre = kernels.chosen(valid, point, 0.0), kernels.chosen(valid, centre, 0.0)
    return valid, point, centre


def _legs(point, centre, surface, steps: int) -> tuple:
    """Legs to the crossing and on, depth, and where the camera is below the surface."""
    p, c = kernels.double(point), kernels.double(centre)
    if surface is None:
        none = (p[2] - c[2]) * 0.0
        return (kernels.minus(p, c), (none, none, none)), none, none > 0.0
    below = height_over(surface, centre) <= kernels.CONTACT
    if isinstance(surface, FlatWater):
        *legs, depth = surface.legs(centre, point, steps)
        return legs, depth, below
    seen, depth = surface.crossing(centre, point, steps)
    seen, xp = kernels.double(seen), namespace(*p)
    # Where the surface has no height there is no water.
    depth = xp.where(xp.isnan(depth), 0.0, depth)
    found = ~xp.isnan(seen[0])
    legs = tuple(kernels.chosen(found, leg, math.nan) for leg in (kernels.minus(seen, c), kernels.minus(p, seen)))
    return legs, depth, below


@quiet
def crossing_point(points, camera, surface: WaterSurface | None, *, steps: int = EXACT_STEPS):
    """Point of the water surface (..., 3) [m], local, through which the camera sees a point of the bed.

    The point itself where the ray to it is straight; better than 1e-9 m in float64. Arguments and errors as for
    `project`, of which this is the crossing and costs less.
    """
    require_surface(surface)
    points, camera = common(points=points, camera=camera)
    valid, point, centre = _ends(components(points), components(camera), surface)
    crossing = point if surface is None else surface.crossing(centre, point, steps)[0]
    return _stacked(valid, crossing, point[0])
