"""Optics of a plane interface, component by component, for numpy, torch and Dr.Jit.

Vectors are triples ``(x, y, z)`` of arrays of any one library; all lengths are in one unit (metres).

    n_from, n_to   refractive index before and after the crossing, in the order of travel
    H              height of the camera above the water plane, along its normal
    h              depth of the bed point below the plane, along its normal
    D              distance between the two, along the plane
    share          part of D that the path covers in air, 0 to 1; the air leg runs over ``share D``
"""

import math
from typing import Any, NamedTuple

from refract._array import in_blocks, namespace

# A ray that falls less than this per metre runs along the surface: it would meet the water beyond 1e12 H.
GRAZING = 1e-12

# A camera this little above the water [m] touches it: the squares of smaller lengths vanish in float32, in which
# `air_share` begins, and an atom is 1e5 times larger.
CONTACT = 1e-15

# Tolerance of the length of a direction. A deviation turns a bent ray by up to as many radians; three roundings of
# float32 make a tenth of it.
UNIT = 5e-6

# Coordinates beyond this [m], a tenth of a light year, count as invalid: up to it, products of squares stay within
# float32, so that no derivative overflows.
REACH = 1e15

_NOTHING = 1e-30  # The smallest positive denominator in a fraction of lengths [m]: 1e-30 times 1e8 is still a float32


def _fused(xp, a, b, c):
    """``a b + c``, where a plain zero or one for ``b``, as of a level plane, costs nothing."""
    if type(b) is float and b in (0.0, 1.0):
        return c if b == 0.0 else a if type(c) is float and c == 0.0 else a + c
    return a * b if type(c) is float and c == 0.0 else xp.fma(a, b, c)


def dot(a, b):
    """Scalar product of two triples."""
    xp = namespace(*a, *b)
    return _fused(xp, a[0], b[0], _fused(xp, a[1], b[1], _fused(xp, a[2], b[2], 0.0)))


def point_at_distance(origin, direction, t):
    """The point at distance ``t`` from ``origin`` along ``direction``."""
    xp = namespace(t, *origin, *direction)
    return tuple(_fused(xp, t, d, o) for o, d in zip(origin, direction, strict=True))


def minus(a, b):
    """The difference of two triples."""
    return tuple(p if type(q) is float and q == 0.0 else p - q for p, q in zip(a, b, strict=True))


def height_over_plane(position, plane_point, normal):
    """Signed height of a position over a plane, along its normal."""
    xp, height = namespace(*position, *plane_point, *normal), 0.0
    for p, q, m in reversed(tuple(zip(position, plane_point, normal, strict=True))):
        if not (type(m) is float and m == 0.0):
            height = _fused(xp, p - q, m, height)
    return height


def tangential_part(vector, normal):
    """The part of a vector along a plane of a normal."""
    if all(type(m) is float for m in normal) and tuple(normal) == (0.0, 0.0, 1.0):
        return vector[0], vector[1], 0.0
    return point_at_distance(vector, normal, -dot(vector, normal))


def double(triple):
    """A triple in float64."""
    return tuple(namespace(v).double(v) for v in triple)


def chosen(mask, a, b):
    """Triple or number ``a`` where ``mask`` holds, else triple or number ``b``."""
    select = selector(mask)
    a, b = (v if type(v) in (tuple, list) else (v, v, v) for v in (a, b))
    return tuple(select(p, q) for p, q in zip(a, b, strict=True))


def selector(mask):
    """A function of two arrays or numbers: the first where ``mask`` holds, else the second.

    Where the mask can be read and is the same everywhere, as over open water, no array is touched, unless derivatives
    are tracked: those of what is left out are zero, not None.
    """
    xp = namespace(mask)
    same = xp.same(mask)

    def select(p, q):
        kept = p if same else q
        if same is not None and getattr(kept, "shape", None) == mask.shape and not xp.tracked(p, q):
            return kept
        return xp.where(mask, p, q)

    return select


def is_unit(direction):
    """Whether a direction has length one within `UNIT`; false where a component is NaN or infinite."""
    return namespace(*direction).abs(dot(direction, direction) - 1.0) < 2.0 * UNIT


def in_reach(*triples):
    """Whether all components are finite and within `REACH`."""
    first, *others = (_squared(triple) for triple in triples)
    return sum(others, first) < REACH * REACH


def _squared(triple):
    """The sum of squares; numpy has no multiply-add, but adds in place."""
    if namespace(*triple).name != "numpy":
        return dot(triple, triple)
    total = triple[0] * triple[0]
    for component in triple[1:]:
        total += component * component
    return total


def cleaned(*triples):
    """Whether all components are `in_reach`, and the triples with zeros elsewhere.

    With zeros an invalid ray does not spoil the gradients of the others; numpy has no gradients, and keeps its
    numbers. The caller puts NaN back into the results.
    """
    valid = in_reach(*triples)
    xp = namespace(valid)
    return valid, triples if xp.name == "numpy" else tuple(chosen(valid, triple, 0.0) for triple in triples)


def near_critical(ray, normal, n_from, n_to):
    """Whether a ray leaves the denser medium so near the critical angle that its derivative is not to be trusted.

    The cosine behind the surface is the root of a small difference: its derivative grows as one over it, and so
    does the rounding, as ``eps / cos^2``. Nearer than ``cos^2 = sqrt(eps)`` less than half of the digits are left.
    """
    xp = namespace(*ray, *normal)
    eta = n_from / n_to
    scaled = eta * dot(ray, normal)
    cos_to_squared = xp.fma(scaled, scaled, (1.0 - eta) * (1.0 + eta))
    return (cos_to_squared >= 0.0) & (cos_to_squared < xp.eps(cos_to_squared) ** 0.5) & (eta > 1.0)


def bend(ray, normal, n_from, n_to):
    """Direction after the crossing; NaN, with zero gradient, where the ray is totally reflected.

    ``normal`` lies on the side that the ray comes from (``ray . normal < 0``); a ray along the surface, or from
    the other side, gives NaN too. The component along the surface scales by ``n_from / n_to``; the cosine to the
    normal follows from ``1 - c_to^2 = eta^2 (1 - c_from^2)``, written so that grazing rays lose no digits and an
    equal index on both sides returns the ray to the last bit, where roots are rounded correctly (torch's are not on
    processors without AVX2: a unit in the last place). The gradient of rays that are `near_critical` is zero.
    """
    xp = namespace(*ray, *normal)
    eta = n_from / n_to
    cos_from = -dot(ray, normal)
    scaled = eta * cos_from
    cos_to_squared = xp.fma(scaled, scaled, (1.0 - eta) * (1.0 + eta))
    if isinstance(eta, float) and eta < 1.0:  # every ray enters the denser medium, and the root is never zero
        bent = _turned(xp, ray, normal, eta, scaled - xp.sqrt(cos_to_squared))
        return chosen(cos_from > 0.0, bent, math.nan)
    # A root is taken only of positive numbers: its gradient at zero is infinite, and infinity times zero NaN.
    positive = cos_to_squared > 0.0
    cos_to = xp.sqrt(xp.where(positive, cos_to_squared, cos_to_squared * 0.0 + 1.0))
    bent = _turned(xp, ray, normal, eta, scaled - xp.where(positive, cos_to, cos_to * 0.0))
    if xp.tracked(*ray, *normal, eta):
        bent = chosen(near_critical(ray, normal, n_from, n_to), tuple(xp.fixed(b) for b in bent), bent)
    return chosen((cos_to_squared >= 0.0) & (cos_from > 0.0), bent, math.nan)


def _turned(xp, ray, normal, eta, push):
    """``eta ray + push normal``."""
    return tuple(_fused(xp, push, m, eta * d) for d, m in zip(ray, normal, strict=True))


def air_share(D_squared, H, h, n, steps, like=None):
    """Root ``u`` of ``u + h u / S = 1``, ``S^2 = a^2 + b^2 u^2``: the part of D that lies in air.

    With ``a = n H`` and ``b^2 = (n^2 - 1) D^2`` that is Snell's law: ``u D / H`` is the tangent in air, ``u D / S``
    that in water, and the two legs together cover D. The left side rises and is concave. `_start` and ``steps`` steps
    of Halley find the root; four reach the last bits of float64 for any H, h and D (docs/optics.md). With an array
    ``like`` in float32 and the others in float64, only the residual of the equation is computed in float64, and that
    only in the last step, which triples the digits of float32: three steps are enough. Only ``D^2`` enters, so all is
    smooth where the camera is straight above. The derivatives are those of the implicit function: the last step carries
    them, and no step before is differentiated. Being of third order, it has the first two to the last bits.
    """
    terms = n * H, (n - 1.0) * (n + 1.0) * D_squared, h
    xp = namespace(*terms)
    if xp.name == "numpy":
        return in_blocks(lambda *block: (_solved(xp, block, steps, like),), *terms)[0]
    if not xp.tracked(*terms):
        return _solved(xp, terms, steps, like)
    # One more step, with its derivatives.
    u = _solved(xp, terms, max(steps - 1, 0), like)
    r = xp.rsqrt(_square(u, *terms))
    return u - _halley(_left(u, r, *terms), u, r, *terms)


def _solved(xp, terms, steps, like):
    """The root for ``a, b^2, h``, without derivatives."""
    exact = tuple(xp.fixed(v) for v in terms)
    rough = exact if like is None else tuple(xp.like(v, like) for v in exact)
    u = _start(*rough)
    for k in range(steps):
        r = xp.rsqrt(_square(u, *rough))
        base, left = u, _left(u, r, *rough)
        if like is not None and k == steps - 1:
            base, fine_r = xp.like(u, exact[0]), xp.like(r, exact[0])
            fine_r = fine_r * (1.5 - 0.5 * _square(base, *exact) * fine_r * fine_r)  # twice the digits of 1 / S
            left = xp.like(_left(base, fine_r, *exact), u)
        u = base - xp.like(_halley(left, u, r, *rough), base)
    if like is not None:
        # Beyond 1e9 camera heights of water rounding of float32 leads out of the bracket, which ends at nadir, and
        # beyond 1e19 squares overflow: comparing, not `maximum`, which keeps what is not a number.
        u, least = (xp.like(v, exact[0]) for v in (u, 0.999999 * rough[0] / (rough[0] + rough[2])))
        u = xp.where(u > least, u, least)
    return xp.like(u, exact[0])


def _start(a, b_squared, h):
    """The geometric mean of a lower and an upper bound of the share, both in closed form.

    The leg in water is no longer than at nadir and than at the critical angle, so ``u >= a / (a + h)`` and
    ``u >= (b - h) / b``, of which the first is larger while ``B = a + h - b >= 0``. And ``S <= a + b u`` gives a
    quadratic whose root is the upper bound.
    """
    xp = namespace(a, b_squared, h)
    b = xp.sqrt(b_squared)
    B = a + h - b
    wide = xp.abs(B) + xp.sqrt(xp.fma(B, B, 4.0 * a * b))
    steep = B >= 0.0
    above = xp.where(steep, 2.0 * a * a, (b - h) * wide)
    return xp.sqrt(above / xp.where(steep, (a + h) * wide, xp.fma(2.0 * b, b, _NOTHING)))


def _square(u, a, b_squared, h):
    """``S^2``."""
    fma = namespace(u).fma
    return fma(b_squared * u, u, a * a)


def _left(u, r, a, b_squared, h):
    """Residual of the equation at ``u``, where ``r = 1 / S``."""
    return namespace(u).fma(u, h * r, u - 1.0)


def _halley(left, u, r, a, b_squared, h):
    """The step of Halley's method, which is of third order."""
    fma = namespace(u).fma
    near, far = a * a * (r * r), b_squared * u * (r * r)
    bend = near * (h * r)
    slope = 1.0 + bend
    return left * slope / fma(left, 1.5 * bend * far, slope * slope)


class WaterPlane(NamedTuple):
    """A water plane as numbers: a point of it, its unit normal into the air, and the index of water relative to air."""

    point: tuple
    normal: tuple
    n: Any


def crossing_of_point(camera, point, plane: WaterPlane, steps, like=None):
    """Crossing of the water plane by the ray from a bed point to the camera, and the depth of the point.

    For a point on or above the plane (depth <= 0), and for a camera on or below it, the crossing is the
    point itself: the ray is straight. ``steps`` and ``like`` as in `air_share`.
    """
    H, depth, along, straight, share = _shared_out(camera, point, plane, steps, like)
    # From the camera's side: the direction of view keeps its digits even just above the water.
    crossing = point_at_distance(point_at_distance(camera, plane.normal, -H), along, share)
    return chosen(straight, point, crossing), depth


def legs_of_point(camera, point, plane: WaterPlane, steps, like=None):
    """The legs from the camera to the crossing and on to the bed point, and the depth of the point.

    Each counts from its own end: no digits are lost to coordinates far from the origin. Where the ray is straight, the
    first leg is all of it and the second zero. Arguments as for `crossing_of_point`.
    """
    H, depth, along, straight, share = _shared_out(camera, point, plane, steps, like)
    xp = namespace(share)
    air, water = (
        tuple(_fused(xp, -height, m, _fused(xp, part, w, 0.0)) for m, w in zip(plane.normal, along, strict=True))
        for height, part in ((H, share), (depth, 1.0 - share))
    )
    return chosen(straight, minus(point, camera), air), chosen(straight, 0.0, water), depth


def _shared_out(camera, point, plane: WaterPlane, steps, like):
    """Camera height, depth of the point, vector between them along the plane, whether straight, share in air."""
    plane_point, normal, n = plane
    H, depth = height_over_plane(camera, plane_point, normal), -height_over_plane(point, plane_point, normal)
    straight = (depth <= 0.0) | (H <= CONTACT)
    along = tangential_part(minus(point, camera), normal)
    # Straight rays get harmless numbers, so that neither their values nor their gradients can be NaN.
    select = selector(straight)
    share = air_share(dot(along, along), select(1.0, H), select(0.0, depth), n, steps, like)
    return H, depth, along, straight, share


def at_height(origin, direction, height, plane_point, normal, n):
    """Point at which a path from ``origin`` reaches ``height`` over the plane, below it after the bend; NaN for none.

    In closed form, for a direction of any length: along the plane the path runs ``|d_t| / d_n`` per metre of height
    in air, and ``eta |d_t| / sqrt((1 - eta^2) |d|^2 + eta^2 d_n^2)`` in water, ``eta = 1 / n``. Both legs meet at
    height zero, and a far and deep point suffers one rounding instead of a chain of them.
    """
    xp = namespace(*origin, *direction, height)
    H = height_over_plane(origin, plane_point, normal) + height * 0.0
    falling = -dot(direction, normal)
    flat = tangential_part(direction, normal)
    eta = 1.0 / n
    scaled = eta * falling
    in_water = xp.where(height < 0.0, -height, height * 0.0)
    drop = H - height
    reached = (xp.abs(falling) > GRAZING) & (drop * falling >= 0.0)
    bends = reached & (H > CONTACT) & (height < 0.0)
    one = falling * 0.0 + 1.0
    safe_falling = xp.where(reached, falling, one)
    squared = (1.0 - eta) * (1.0 + eta) * dot(direction, direction) + scaled * scaled
    falling_in_water = xp.sqrt(xp.where(bends, squared, one))
    run = xp.where(bends, H / safe_falling + in_water * eta / falling_in_water, drop / safe_falling)
    points = point_at_distance(point_at_distance(origin, normal, -drop), flat, run)
    return chosen(reached, points, math.nan)
