"""The optics of a plane interface, component by component, for numpy, torch and Dr.Jit alike.

Vectors are triples ``(x, y, z)`` of arrays of any one library; all lengths are in one unit (metres).

    n_from, n_to   refractive index before and after the crossing, in the order of travel
    H              height of the camera above the water plane, along its normal
    h              depth of the bed point below the plane, along its normal
    D              distance between the two, along the plane
    share          part of D that the path covers in air, 0 to 1; the air leg runs over ``share D``
"""

from __future__ import annotations

from refract._array import namespace


def dot(a, b):
    """Scalar product of two triples."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def along(origin, direction, t):
    """The point at distance ``t`` from ``origin`` along ``direction``."""
    return tuple(o + t * d for o, d in zip(origin, direction, strict=True))


def bend(ray, normal, n_from, n_to):
    """Direction after the crossing; NaN, with zero gradient, where the ray is totally reflected.

    ``normal`` lies on the side that the ray comes from (``ray . normal < 0``); a ray from the other side
    gives NaN too. The component along the surface scales by ``n_from / n_to``; the cosine to the normal
    follows from ``1 - c_to^2 = eta^2 (1 - c_from^2)``, written so that grazing rays lose no digits and an
    equal index on both sides returns the ray to the last bit.
    """
    xp = namespace(*ray, *normal)
    eta = n_from / n_to
    cos_from = -dot(ray, normal)
    scaled = eta * cos_from
    cos_to_squared = (1.0 - eta) * (1.0 + eta) + scaled * scaled
    passes = (cos_to_squared >= 0.0) & (cos_from >= 0.0)
    # A root is taken only of positive numbers: its gradient at zero is infinite, and infinity times zero NaN.
    positive = cos_to_squared > 0.0
    root = xp.sqrt(xp.where(positive, cos_to_squared, cos_to_squared * 0.0 + 1.0))
    push = scaled - xp.where(positive, root, root * 0.0)
    bent = tuple(eta * d + push * m for d, m in zip(ray, normal, strict=True))
    return tuple(xp.where(passes, b, b * 0.0 + float("nan")) for b in bent)


def air_share(D_squared, H, h, n, steps):
    """Root ``u`` of ``u + (h / H) u q = 1``, the part of the way D that lies in air, by Newton steps.

    With ``x = u D / H`` the tangent in air, Snell's law gives ``tan(theta_w) = x q``,
    ``q = 1 / sqrt(n^2 + (n^2 - 1) x^2)``, and the two legs together must cover D. The left side rises and
    is concave, so Newton steps from below never overshoot and need no bracket. They start at
    ``1 / (1 + h / (n H))``, the ray that aims at the apparent point of nadir, which lies below the root.
    Only ``D^2`` enters: the root is smooth, and so are its derivatives, where the camera is straight above.
    """
    xp = namespace(D_squared, H, h, n)
    ratio = h / H
    widening = (n * n - 1.0) * D_squared / (H * H)
    u = 1.0 / (1.0 + ratio / n)
    for _ in range(steps):
        q = 1.0 / xp.sqrt(n * n + widening * u * u)
        u = u - (u + ratio * u * q - 1.0) / (1.0 + ratio * n * n * q * q * q)
    return u


def crossing_of_point(camera, point, plane_point, normal, n, steps):
    """Where the ray from a bed point to the camera crosses the water plane, and the depth of the point.

    For a point on or above the plane (depth <= 0), and for a camera on or below it, the crossing is the
    point itself: the ray is straight. ``n`` is the index of water relative to air.
    """
    xp = namespace(*point, *camera)
    to_camera = tuple(c - q for c, q in zip(camera, plane_point, strict=True))
    to_point = tuple(p - q for p, q in zip(point, plane_point, strict=True))
    depth = -dot(to_point, normal)
    H = dot(to_camera, normal) + depth * 0.0
    straight = (depth <= 0.0) | (H <= 0.0)
    # Foot points of camera and bed point on the plane, and the way between them.
    way = tuple((c - H * m) - (p + depth * m) for c, p, m in zip(to_camera, to_point, normal, strict=True))
    # Straight rays get harmless numbers, so that neither their values nor their gradients can be NaN.
    share = air_share(
        dot(way, way), xp.where(straight, H * 0.0 + 1.0, H), xp.where(straight, depth * 0.0, depth), n, steps
    )
    # From the camera's side: the direction of view keeps its digits even just above the water.
    crossing = tuple(c - H * m - share * w for c, m, w in zip(camera, normal, way, strict=True))
    return tuple(xp.where(straight, p, x) for p, x in zip(point, crossing, strict=True)), depth
