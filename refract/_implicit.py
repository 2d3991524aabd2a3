"""Derivatives of roots by the implicit function theorem: a Newton step at a root that was found without derivatives.

A Newton step at the root changes the value only by rounding, and makes one more order of derivatives exact: the first
step is the implicit function theorem. torch gets two steps, Dr.Jit, which has no second derivatives, one.
"""

from __future__ import annotations

from refract._array import namespace

# A ray that approaches the surface by less than this per metre where it meets it gets no gradient.
_GRAZING = 1e-9


def along_ray(clearance, t, meets):
    """Distances t with derivatives, where rays meet a surface: ``clearance(t)`` is height over it and rate along it."""
    xp = namespace(t)
    over, rate = clearance(t)
    is_regular = meets & (rate < -_GRAZING)
    slope = xp.fixed(xp.where(is_regular, rate, -1.0))
    for order in range(xp.orders):
        if order > 0:
            over, _ = clearance(t)
        t = t - xp.where(is_regular, over, 0.0) / slope
    return t


def over_surface(gradient, matrix, x, y, is_regular):
    """Crossings x, y with derivatives, where they are regular: roots of ``gradient(x, y)`` with Jacobian ``matrix``."""
    xp = namespace(x)
    rows = tuple(
        tuple(xp.fixed(xp.where(is_regular, entry, unit)) for entry, unit in zip(row, units, strict=True))
        for row, units in zip(matrix, ((1.0, 0.0), (0.0, 1.0)), strict=True)
    )
    for _ in range(xp.orders):
        step_x, step_y = newton_step(gradient(x, y), rows)
        x, y = x + xp.where(is_regular, step_x, 0.0), y + xp.where(is_regular, step_y, 0.0)
    return x, y


def newton_step(gradient, rows):
    """Newton's step to the root of a gradient (x, y), from its Jacobian."""
    (px, py), ((xx, xy), (yx, yy)) = gradient, rows
    determinant = xx * yy - xy * yx
    return (yx * py - yy * px) / determinant, (xy * px - xx * py) / determinant
