"""Refraction at a surface: Snell's law in vector form, apparent depth in closed form, Fresnel's equations.

`fresnel_coefficients` gives the shares of the power that are reflected and transmitted, which add up to 1:

    a = n_from cos(angle_from)      b = n_to cos(angle_to)        both polarisations depend on these
    c = n_to cos(angle_from)        d = n_from cos(angle_to)

    R_s = ((a - b) / (a + b))^2     T_s = 4 a b / (a + b)^2       electric field along the surface
    R_p = ((c - d) / (c + d))^2     T_p = 4 c d / (c + d)^2       electric field in the plane of incidence

(M. Born and E. Wolf, Principles of Optics, section 1.5.)
"""

import math
from typing import Any, NamedTuple

from refract import kernels
from refract._array import common, components, hold, namespace, quiet, stack


@quiet
def bend(ray, normal, *, n_from, n_to):
    """Direction of a ray after it crosses the water surface.

    Raises ValueError if the last axis of `ray` or `normal` is not 3, their shapes do not broadcast, or an index is not
    positive and finite.

    Parameters
    ----------
    ray : (..., 3) unit, any one frame; numpy or torch
        Direction of travel before the crossing.
    normal : (3,) or (..., 3) unit, same frame
        Surface normal on the side the ray comes from, so ``ray . normal < 0``.
    n_from, n_to : [-]
        Refractive index before and after the crossing, in the order of travel; positive.

    Returns
    -------
    (..., 3) unit, same frame
        NaN where the ray is totally reflected (only possible if ``n_from > n_to``), runs along the surface or
        comes from the other side, and where the length of ray or normal is not one (by more than 5e-6); gradients of
        such rays are zero, not NaN. So are those of rays that come out within 0.007 degrees of the surface (float64;
        1.1 degrees in float32), where the derivative diverges.

    Examples
    --------
    A camera ray 30 degrees off nadir enters water; sin 30 deg / 1.333 = 0.3751.

    >>> import numpy as np
    >>> down = np.array([0.5, 0.0, -(0.75**0.5)])
    >>> [round(float(x), 4) for x in bend(down, np.array([0.0, 0.0, 1.0]), n_from=1.0, n_to=1.333)]
    [0.3751, 0.0, -0.927]
    """
    ray, normal = common(ray=ray, normal=normal)
    if not hold(lambda n: (n > 0.0) & (n < math.inf), n_from, n_to):
        raise ValueError(f"expected finite refractive indices above zero, got n_from {n_from} and n_to {n_to}")
    ray, normal = components(ray), components(normal)
    unit = kernels.is_unit(ray) & kernels.is_unit(normal)
    return stack(*kernels.chosen(unit, kernels.bend(ray, normal, n_from, n_to), math.nan))


def apparent_depth(depth, angle, *, n_water: float):
    """Sagittal apparent depth [m]: ``h cos(a) / sqrt(n^2 - sin^2 a)``; ``h / n`` at nadir.

    What straight rays make of a bed under flat water; ``angle`` is the incidence in air [rad]; numpy, torch or floats.
    Two cameras on opposite sides at equal incidence (any symmetric ring) see the *sagittal* image straight above the
    point; cameras in one vertical plane through the point see the *tangential* image on the caustic. A real network of
    views lies between the two, and always above the bed: straight rays make the bed too shallow.
    """
    depth, angle = common(depth=depth, angle=angle)
    xp = namespace(depth, angle)
    return depth * xp.cos(angle) / xp.sqrt(n_water**2 - xp.sin(angle) ** 2)


def true_depth(apparent, angle, *, n_water: float):
    """Inverse of `apparent_depth`: true depth [m] of a point whose sagittal image lies at `apparent` [m]."""
    apparent, angle = common(apparent=apparent, angle=angle)
    xp = namespace(apparent, angle)
    return apparent * xp.sqrt(n_water**2 - xp.sin(angle) ** 2) / xp.cos(angle)


def apparent_depth_tangential(depth, angle, *, n_water: float):
    """Tangential apparent depth [m]: ``h n^2 cos^3(a) / (n^2 - sin^2 a)^(3/2)``."""
    depth, angle = common(depth=depth, angle=angle)
    xp = namespace(depth, angle)
    return depth * n_water**2 * xp.cos(angle) ** 3 / (n_water**2 - xp.sin(angle) ** 2) ** 1.5


def tangential_shift(depth, angle, *, n_water: float):
    """Shift [m] of the tangential image toward the camera: ``h (n^2 - 1) tan^3(angle in water)``."""
    depth, angle = common(depth=depth, angle=angle)
    xp = namespace(depth, angle)
    sine = xp.sin(angle) / n_water
    return depth * (n_water**2 - 1.0) * (sine / xp.sqrt(1.0 - sine**2)) ** 3


class Fresnel(NamedTuple):
    """Shares of the light of each polarisation that are reflected and that pass, each of the shape of the rays."""

    reflectance_s: Any
    reflectance_p: Any
    transmittance_s: Any
    transmittance_p: Any

    @property
    def reflectance(self):
        """Reflectance of unpolarised light."""
        return 0.5 * (self.reflectance_s + self.reflectance_p)

    @property
    def transmittance(self):
        """Transmittance of unpolarised light."""
        return 0.5 * (self.transmittance_s + self.transmittance_p)


def fresnel_coefficients(cos_from, *, n_from, n_to) -> Fresnel:
    """Power coefficients (reflectance, transmittance) of a smooth surface between two media, in either direction.

    Parameters
    ----------
    cos_from : (...), 0 to 1
        Cosine of the angle between the ray and the normal, on the side that the light comes from.
    n_from, n_to : [-]
        Refractive index before and after the surface, in the order of travel.

    Returns
    -------
    Fresnel
        Total reflection is 1, with zero gradient; elsewhere gradients are finite, at normal incidence and along the
        surface too, though without bound towards the critical angle. NaN where the cosine is negative.

    Examples
    --------
    Straight down, light loses 2 % at the surface of water.

    >>> round(float(fresnel_coefficients(1.0, n_from=1.0, n_to=1.333).reflectance), 4)
    0.0204
    """
    xp = namespace(cos_from, n_from, n_to)
    eta = n_from / n_to
    scaled = eta * cos_from
    # As in kernels.bend: no digits are lost along the surface, and none at equal indices.
    cos_to_squared = (1.0 - eta) * (1.0 + eta) + scaled * scaled
    # A root is taken only of positive numbers: its gradient at zero is infinite, and infinity times zero NaN.
    passes = cos_to_squared > 0.0
    zero = cos_to_squared * 0.0
    cos_to = xp.sqrt(xp.where(passes, cos_to_squared, zero + 1.0))
    nothing = xp.where(cos_from >= 0.0, zero, zero + float("nan"))
    shares = []
    for incident, transmitted in ((n_from * cos_from, n_to * cos_to), (n_to * cos_from, n_from * cos_to)):
        both = incident + transmitted
        reflected, passed = (incident - transmitted) / both, 4.0 * incident * transmitted / (both * both)
        shares.append(xp.where(passes, reflected * reflected, zero + 1.0) + nothing)
        shares.append(xp.where(passes, passed, zero) + nothing)
    r_s, t_s, r_p, t_p = shares
    return Fresnel(r_s, r_p, t_s, t_p)
