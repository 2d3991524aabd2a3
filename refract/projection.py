"""Where a point under water appears to a camera: the way back up through the surface."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from refract import kernels
from refract._array import common, components, namespace, stack
from refract.regimes import Regime, counts
from refract.surfaces import WaterSurface

# More than any surface needs for the last bits of float64; a plane takes four at most (docs/optics.md).
EXACT_STEPS = 16


@final
@dataclass(frozen=True)
class Projection:
    """How a camera sees points through the water; arrays of the library and precision of the points, local frame.

    Attributes
    ----------
    direction : (..., 3) unit
        From the camera toward where the point appears; NaN where it cannot be seen.
    crossing : (..., 3) [m]
        Where the ray meets the surface; the point itself where the ray is straight.
    air_length, water_length : (...) [m]
        Of the two legs; a straight ray is all air, or, from a camera under water to a wet point, all water.
    depth : (...) [m]
        Of the point below the surface, along the normal of a plane, vertical for a curved surface; zero without water.
    wet : (...) bool
        The point is below the surface.
    solutions : (...) int
        Stationary paths that were found; the least optical one was taken.
    under_water : (...) bool
        The camera is on or below the surface.
    """

    direction: Any
    crossing: Any
    air_length: Any
    water_length: Any
    depth: Any
    wet: Any
    solutions: Any
    under_water: Any

    @property
    def regime(self):
        """`Regime` of each ray, (...) int."""
        xp, length = namespace(self.depth), self.air_length + self.water_length
        code = xp.where(self.wet, int(Regime.BENT), int(Regime.STRAIGHT))
        code = xp.where(self.under_water, int(Regime.UNDER_WATER), code)
        code = xp.where(xp.isnan(length), int(Regime.UNSEEN), code)
        return xp.where(xp.isnan(self.depth) | (length == 0.0), int(Regime.INVALID), code)

    def counts(self) -> dict[str, int]:
        """How many points there are of each `Regime`, by its name in lower case."""
        return counts(self.regime)


def _length(vector):
    """Length of a triple, and one over it; zero and one, with zero gradients, where it vanishes."""
    xp = namespace(*vector)
    squared = kernels.dot(vector, vector)
    inverse = xp.rsqrt(xp.where(squared == 0.0, 1.0, squared))
    return squared * inverse, inverse


@np.errstate(invalid="ignore", over="ignore")
def project(points, camera, surface: WaterSurface | None, *, steps: int = EXACT_STEPS) -> Projection:
    """How a camera sees points of the bed: the way of least optical path (Fermat) through the surface.

    Points and camera in float32 are computed in float64 where digits would be lost, and rounded once at the end.

    Parameters
    ----------
    points : (..., 3) [m], local; numpy, torch, or a Dr.Jit Array3f or Array3f64
    camera : (3,) or (..., 3) [m], local
        Camera centre.
    surface : WaterSurface or None
        None: there is no water, and every ray is straight.
    steps : int
        Steps that the solver of the surface may take; fewer are faster (docs/optics.md).

    Returns
    -------
    Projection
        Rays to points above the water, from a camera on or below it, and without water are straight. A point that
        is NaN, or lies in the camera, has a direction of NaN. A single bad ray never raises; `counts` reports it.

    Raises
    ------
    ValueError
        If the last axis of `points` or `camera` is not 3, or their shapes do not broadcast.
    """
    points, camera = common(points=points, camera=camera)
    point, centre = components(points), components(camera)
    xp = namespace(*point)
    valid, (point, centre) = kernels.cleaned(point, centre)
    p, c = kernels.double(point), kernels.double(centre)
    seen, depth, solutions, below = p, p[2] * 0.0, 1, ~valid
    if surface is not None:
        seen, depth, solutions = surface.crossing(centre, point, steps)
        seen = kernels.double(seen)
        below = centre[2] - surface.height(centre[0], centre[1]) <= kernels.CONTACT
    wet = valid & (depth > 0.0)
    sunk = wet & below
    # Differences are taken in float64; their lengths may be rounded.
    leg, rest = (tuple(xp.like(v, point[0]) for v in kernels.minus(*ends)) for ends in ((seen, c), (p, seen)))
    (leg_length, inverse), (rest_length, _) = _length(leg), _length(rest)
    apart = valid & (leg_length != 0.0)
    return Projection(
        direction=stack(*kernels.chosen(apart, tuple(v * inverse for v in leg), math.nan)),
        crossing=stack(*kernels.chosen(valid, tuple(xp.like(v, point[0]) for v in seen), math.nan)),
        air_length=xp.where(valid, xp.where(sunk, leg_length * 0.0, leg_length), math.nan),
        water_length=xp.where(valid, xp.where(sunk, leg_length, rest_length), math.nan),
        depth=xp.where(valid, xp.like(depth, point[0]), math.nan),
        wet=wet,
        solutions=solutions,
        under_water=valid & below,
    )


@np.errstate(invalid="ignore", over="ignore")
def crossing_point(points, camera, surface: WaterSurface | None, *, steps: int = EXACT_STEPS):
    """Point of the water surface (..., 3) [m], local, through which the camera sees a point of the bed.

    The point itself where the ray to it is straight; better than 1e-9 m in float64. Arguments and errors as for
    `project`, of which this is the crossing and costs less.
    """
    points, camera = common(points=points, camera=camera)
    point, centre = components(points), components(camera)
    xp = namespace(*point)
    valid, (point, centre) = kernels.cleaned(point, centre)
    crossing = point if surface is None else surface.crossing(centre, point, steps)[0]
    return stack(*kernels.chosen(valid, tuple(xp.like(v, point[0]) for v in crossing), math.nan))
