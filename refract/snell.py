"""Snell's law in vector form."""

from __future__ import annotations

import math

from refract import kernels
from refract._array import common, components, namespace, quiet, stack
from refract._empty import of_any_size
from refract._numbers import hold
from refract.regimes import Regime


@of_any_size
@quiet
def bend(ray, normal, *, n_from, n_to):
    """Direction of a ray after it crosses the water surface.

    Parameters
    ----------
    ray : (..., 3) unit, any one frame; numpy, torch, or a Dr.Jit Array3f or Array3f64
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
        such rays are zero, not NaN. So are those of rays that come out
        within 0.007 degrees of the surface (float64; 1.1 degrees in float32), where the derivative diverges;
        `bend_regime` distinguishes them.

    Raises
    ------
    ValueError
        If the last axis of `ray` or `normal` is not 3, their shapes do not broadcast, or an index is not
        positive and finite.

    Examples
    --------
    A camera ray 30 degrees off nadir enters water; sin 30 deg / 1.333 = 0.3751.

    >>> import numpy as np
    >>> down = np.array([0.5, 0.0, -(0.75**0.5)])
    >>> [round(float(x), 4) for x in bend(down, np.array([0.0, 0.0, 1.0]), n_from=1.0, n_to=1.333)]
    [0.3751, 0.0, -0.927]
    """
    ray, normal = common(ray=ray, normal=normal)
    _require_positive(n_from, n_to)
    ray, normal = components(ray), components(normal)
    unit = kernels.is_unit(ray) & kernels.is_unit(normal)
    return stack(*kernels.chosen(unit, kernels.bend(ray, normal, n_from, n_to), math.nan))


def _require_positive(n_from, n_to) -> None:
    if not hold(lambda n: (n > 0.0) & (n < math.inf), n_from, n_to):
        raise ValueError(f"expected finite refractive indices above zero, got n_from {n_from} and n_to {n_to}")


@of_any_size
@quiet
def bend_regime(ray, normal, *, n_from, n_to):
    """What `bend` makes of each ray: an array (...) of `Regime` codes, for `counts`. Arguments as for `bend`."""
    ray, normal = common(ray=ray, normal=normal)
    _require_positive(n_from, n_to)
    ray, normal = components(ray), components(normal)
    xp = namespace(*ray)
    unit = kernels.is_unit(ray) & kernels.is_unit(normal)
    bent = kernels.bend(ray, normal, n_from, n_to)[0]
    cos_from = -kernels.dot(ray, normal)
    code = xp.where(kernels.near_critical(ray, normal, n_from, n_to), int(Regime.CRITICAL), int(Regime.BENT))
    code = xp.where(xp.isnan(bent), int(Regime.REFLECTED), code)
    code = xp.where(cos_from == 0.0, int(Regime.PARALLEL), code)
    return xp.where(unit, code, int(Regime.INVALID))
