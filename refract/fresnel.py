"""Fresnel's equations: reflectance and transmittance of a water surface, and radiance across it.

    a = n_from cos(angle_from)      b = n_to cos(angle_to)        both polarisations depend on these
    c = n_to cos(angle_from)        d = n_from cos(angle_to)

    R_s = ((a - b) / (a + b))^2     T_s = 4 a b / (a + b)^2       electric field along the surface
    R_p = ((c - d) / (c + d))^2     T_p = 4 c d / (c + d)^2       electric field in the plane of incidence

(M. Born and E. Wolf, Principles of Optics, section 1.5.) R and T are shares of the power that arrives; they add up
to 1. Numpy, torch and Dr.Jit alike.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from refract._array import namespace
from refract._numbers import of_any_size


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


@of_any_size
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
    for here, there in ((n_from * cos_from, n_to * cos_to), (n_to * cos_from, n_from * cos_to)):
        reflected, passed = (here - there) / (here + there), 4.0 * here * there / ((here + there) * (here + there))
        shares.append(xp.where(passes, reflected * reflected, zero + 1.0) + nothing)
        shares.append(xp.where(passes, passed, zero) + nothing)
    r_s, t_s, r_p, t_p = shares
    return Fresnel(r_s, r_p, t_s, t_p)
