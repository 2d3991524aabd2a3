"""Projection of points under water: the direction in which a camera sees them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
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
    """Projection of points through the water; arrays of the library and precision of the points, local frame.

    Crossing and lengths are computed when they are asked for.

    Attributes
    ----------
    crossing : (..., 3) [m]
        Where the ray meets the surface; the point itself where the ray is straight.
    air_length, water_length : (...) [m]
        Of the two legs; a straight ray is all air, or, from a camera under water to a wet point, all water.
    """

    direction: Any  # (..., 3) unit: from the camera toward where the point appears; NaN where it cannot be seen
    # (...) [m]: of the point below the surface, along the normal of a plane, vertical for a curved surface; zero
    # without water
    depth: Any
    wet: Any  # (...) bool: the point is below the surface
    under_water: Any  # (...) bool: the camera is on or below the surface
    # Where all is in reach; the point; the legs to the crossing and on to the point; `_measured` of the first.
    _valid: Any = field(repr=False)
    _point: tuple[Any, Any, Any] = field(repr=False)
    _legs: tuple = field(repr=False)
    _first: tuple = field(repr=False)

    @property
    @quiet
    def crossing(self):
        """See the class."""
        return _stacked(self._valid, kernels.minus(self._point, self._legs[1]), self.depth)

    @property
    @quiet
    def air_length(self):
        """See the class."""
        return self._select(0.0, _length(*self._first))

    @property
    @quiet
    def water_length(self):
        """See the class."""
        return self._select(_length(*self._first), _length(*_measured(self._legs[1])))

    def _select(self, sunk, others):
        """``sunk`` where the camera is under water and the ray straight, ``others`` elsewhere, NaN where invalid."""
        xp = namespace(self.depth)
        number = xp.where(self.wet & self.under_water, sunk, others)
        return xp.where(self._valid, xp.like(number, self.depth), math.nan)

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
    """Square of the length of a leg, and one over the length; one where there is no leg."""
    xp = namespace(*leg)
    squared = kernels.dot(leg, leg)
    return squared, xp.rsqrt(xp.where(squared < _NO_LEG, 1.0, squared))


def _length(squared, inverse):
    """The length of a leg, zero without gradient where there is none."""
    return namespace(squared).where(squared < _NO_LEG, 0.0, squared * inverse)


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
    wet = valid & (depth > 0.0)
    squared, inverse = _measured(legs[0])
    seen = valid & ~(squared < _NO_LEG)
    direction = _stacked(seen, tuple(c * inverse for c in legs[0]), point[0])
    depth = xp.where(valid, xp.like(depth, point[0]), math.nan)
    numbers = depth, wet, valid & below
    numbers = spread(*numbers, direction[..., 0])[:3]
    return Projection(
        direction, *numbers, _valid=valid, _point=kernels.double(point), _legs=legs, _first=(squared, inverse)
    )


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
