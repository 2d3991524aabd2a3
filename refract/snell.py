"""Snell's law in vector form."""

from __future__ import annotations

from refract import kernels
from refract._array import common, components, stack


def bend(ray, normal, *, n_from: float, n_to: float):
    """Direction of a ray after it crosses the water surface.

    Parameters
    ----------
    ray : (..., 3) unit, any one frame, numpy or torch
        Direction of travel before the crossing.
    normal : (3,) or (..., 3) unit, same frame
        Surface normal on the side the ray comes from, so ``ray . normal < 0``.
    n_from, n_to : [-]
        Refractive index before and after the crossing, in the order of travel.

    Returns
    -------
    (..., 3) unit, same frame
        NaN where the ray is totally reflected (only possible if ``n_from > n_to``) or comes from the
        other side; gradients of such rays are zero, not NaN.

    Raises
    ------
    ValueError
        If the last axis of `ray` or `normal` is not 3, or their shapes do not broadcast.

    Examples
    --------
    A camera ray 30 degrees off nadir enters water; sin 30 deg / 1.333 = 0.3751.

    >>> import numpy as np
    >>> down = np.array([0.5, 0.0, -(0.75**0.5)])
    >>> [round(float(x), 4) for x in bend(down, np.array([0.0, 0.0, 1.0]), n_from=1.0, n_to=1.333)]
    [0.3751, 0.0, -0.927]
    """
    ray, normal = common(ray=ray, normal=normal)
    return stack(*kernels.bend(components(ray), components(normal), n_from, n_to))
