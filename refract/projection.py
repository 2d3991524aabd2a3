"""Projection of points under water: the direction in which a camera sees them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, final

from refract import kernels
from refract._array import common, components, namespace, quiet, spread, stack
from refract.snell import Regime, regime_counts
from refract.surfaces import FlatWater, WaterSurface, derivable, height_over, require_surface

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
    under_water: Any  # (...) bool: the camera is on or below the surface
    crossing: Any  # (..., 3) [m]: where the ray meets the surface; the point itself where the ray is straight
    # (...) [m]: of the two legs; a straight ray is all air, or, from a camera under water to a wet point, all water
    air_length: Any
    water_length: Any

    @property
    def regime(self):
        """`Regime` of each ray, (...) int."""
        xp, length = namespace(self.depth), self.air_length + self.water_length
        code = xp.where(self.wet, int(Regime.BENT), int(Regime.STRAIGHT))
        code = xp.where(self.under_water, int(Regime.UNDER_WATER), code)
        code = xp.where(xp.isnan(length), int(Regime.UNSEEN), code)
        return xp.where(xp.isnan(self.depth) | (length == 0.0), int(Regime.INVALID), code)

    def regime_counts(self) -> dict[str, int]:
        """Number of points of each `Regime`, by its name in lower case."""
        return regime_counts(self.regime)


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
        point that is NaN, farther out than 1e15 m, or in the camera, has a direction of NaN. A single bad ray never
        raises; `regime_counts` reports it.
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
    depth, wet, below, air, water, _ = spread(depth, wet, below, air, water, direction[..., 0])
    return Projection(direction, depth, wet, below, crossing, air, water)


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
