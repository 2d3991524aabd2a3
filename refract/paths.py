"""Rays bent at the water surface: from the camera down to the bed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from refract import kernels
from refract._array import common, components, namespace, stack
from refract.surfaces import FlatWater

# A ray that falls less than this per metre runs along the surface: it would meet the water beyond 1e12 H.
_GRAZING = 1e-12


@dataclass(frozen=True)
class BentPaths:
    """Paths of rays from the camera through the water surface; arrays are numpy or torch, local frame.

    Attributes
    ----------
    origin : (..., 3) [m]
        Camera centre.
    air_direction : (..., 3) unit
    crossing : (..., 3) [m]
        Where the ray meets the surface; NaN where it never does.
    air_length : (...) [m]
        From origin to crossing; infinite where the ray never meets the water.
    water_direction : (..., 3) unit
        Direction after the crossing; equal to `air_direction` where the ray never meets the water,
        or where the camera is below the surface.
    wet : (...) bool
        The ray enters the water if nothing dry stops it first.
    """

    origin: Any
    air_direction: Any
    crossing: Any
    air_length: Any
    water_direction: Any
    wet: Any

    def at(self, t):
        """Points (..., 3) [m] at path length ``t`` (...) [m] from the camera, air and water legs together.

        Raises
        ------
        ValueError
            If the shape of `t` does not broadcast against that of the rays.
        """
        t, air_length = common(t=t, rays=self.air_length)
        xp = namespace(air_length)
        in_air = (t <= air_length) | ~self.wet
        t_air = xp.where(in_air, t, air_length)
        t_water = xp.where(in_air, t * 0.0, t - air_length)
        return self.origin + t_air[..., None] * self.air_direction + t_water[..., None] * self.water_direction

    def at_height(self, height, water: FlatWater | None):
        """Points (..., 3) [m] where the paths stand ``height`` (...) [m] above the water plane.

        Heights are measured along the normal of the plane and negative below it. Both legs meet at height
        zero, so a hypothesis in height passes the shoreline without a step. Without water, ``height`` counts
        from local z = 0. NaN where the path never stands at that height: it lies behind the camera, or the
        ray runs along the surface.

        Raises
        ------
        ValueError
            If the shape of `height` does not broadcast against that of the rays.
        """
        height, _ = common(height=height, rays=self.air_length)
        xp = namespace(self.origin)
        normal = water.up if water is not None else (0.0, 0.0, 1.0)
        plane = water.point if water is not None else (0.0, 0.0, 0.0)
        origin = components(self.origin)
        H = kernels.dot(tuple(c - p for c, p in zip(origin, plane, strict=True)), normal) + height * 0.0
        # Below the surface the path goes on from the crossing, or from a camera that is under water itself.
        below = self.wet & (height < 0.0)
        start = tuple(xp.where(below, x, o) for x, o in zip(components(self.crossing), origin, strict=True))
        air, water_leg = components(self.air_direction), components(self.water_direction)
        leg = tuple(xp.where(below, w, a) for w, a in zip(water_leg, air, strict=True))
        rise = height - xp.where(below, xp.minimum(H, H * 0.0), H)
        climb = kernels.dot(leg, normal)
        reached = (xp.abs(climb) > _GRAZING) & (rise * climb >= 0.0)
        t = rise / xp.where(reached, climb, climb * 0.0 + 1.0)
        points = kernels.along(start, leg, t)
        return stack(*(xp.where(reached, p, p * 0.0 + float("nan")) for p in points))


def trace(origin, direction, water: FlatWater | None) -> BentPaths:
    """Bend camera rays at the water surface.

    Parameters
    ----------
    origin, direction : (..., 3) numpy or torch, local [m] and unit
        Camera centres and directions of view; they broadcast.
    water : FlatWater or None
        None leaves every ray straight and dry.

    Returns
    -------
    BentPaths
        A ray that never meets the water (it looks up, or runs along the surface) is straight and not wet, and
        only its crossing is NaN. A camera on or below the surface looks straight through the water; it counts
        as wet, with a crossing at the camera.

    Raises
    ------
    ValueError
        If the last axis of `origin` or `direction` is not 3, or their shapes do not broadcast.
    """
    origin, direction = common(origin=origin, direction=direction)
    xp = namespace(origin)
    o, d = components(origin), components(direction)
    zero = (o[0] + d[0]) * 0.0
    o, d = tuple(c + zero for c in o), tuple(c + zero for c in d)
    nowhere, endless = zero + float("nan"), zero + float("inf")
    if water is None:
        crossing = stack(nowhere, nowhere, nowhere)
        return BentPaths(stack(*o), stack(*d), crossing, endless, stack(*d), zero > 0.0)
    normal, plane = water.up, water.point
    H = kernels.dot(tuple(c - p for c, p in zip(o, plane, strict=True)), normal)
    falling = -kernels.dot(d, normal)
    below = H <= 0.0
    meets = (falling > _GRAZING) & ~below
    wet = meets | below
    reach = xp.where(meets, H / xp.where(meets, falling, zero + 1.0), zero)
    air_length = xp.where(wet, reach, endless)
    crossing = tuple(xp.where(wet, c, nowhere) for c in kernels.along(o, d, reach))
    bent = kernels.bend(d, tuple(zero + m for m in normal), 1.0, water.n_water)
    water_direction = tuple(xp.where(meets, b, c) for b, c in zip(bent, d, strict=True))
    return BentPaths(stack(*o), stack(*d), stack(*crossing), air_length, stack(*water_direction), wet)
