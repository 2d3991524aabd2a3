"""All stationary paths of a point by interval Newton: boxes are cut until each is empty or has exactly one.

Krawczyk's operator: with gradient F and Hessian H of the optical length, Y an approximate inverse of H and m the middle
of a box X, every root of F in X lies in ``K = m - Y F(m) + (I - Y H(X)) (X - m)``. If K misses X there is none; if K
lies inside X there is exactly one (R. Krawczyk, Computing 4, 1969; R. E. Moore, SIAM J. Numer. Anal. 14, 1977). All in
numpy float64; H(X) and F(m) are enclosed by interval arithmetic on numpy arrays, the proof behind
`refract.curved.fermat`: a result contains every value that the operation takes over its arguments: bounds move outward
by one unit in the last place after the correctly rounded operations, by a few after sine and cosine. An `Interval`
answers numpy's functions and operators (NEP 13), so formulas written once for numbers also give enclosures.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import takewhile

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

# A root on the common side of two boxes lies inside neither: boxes are tested a little wider than they are cut.
_OVERLAP = 1.125
# Boxes per point. A calm sea takes none, a caustic some hundreds; more mean a point on a caustic.
_BUDGET = 4000
# Boxes smaller than this part of the camera's distance are not cut any more: there, rounding hides the sign of F.
_SMALLEST = 1e-10
# Points at a time: some hundred boxes each, a few dozen intervals per box, tens of MB.
_CHUNK = 256
_POLISH = 4
# One unit in the last place is at most this part of a number, or this much (the smallest normal number).
_ULP, _LEAST = 2.0**-52, 2.0**-1022
# numpy's sine and cosine are good to 4 units in the last place, of values of at most one: 9e-16.
_SINE_SLACK = 1e-15


def every_path(surface, path_slope, camera, point, disc):
    """Crossings of all stationary paths of each point, and which points the proof could not decide.

    Parameters
    ----------
    path_slope : callable
        `refract.curved.fermat.path_slope`, for numbers and intervals alike.
    camera, point : triples of (points,) float64
    disc : Disc
        Holds every crossing.

    Returns
    -------
    owner, x, y : (roots,) int, float64
        Which point each crossing belongs to, in order.
    open : (points,) bool
    """
    found, unproven = [], np.zeros(point[0].size, dtype=bool)
    for start in range(0, point[0].size, _CHUNK):
        part = slice(start, start + _CHUNK)
        ends = tuple(c[part] for c in camera), tuple(p[part] for p in point)
        owner, x, y, unproven[part] = _cut(surface, path_slope, *ends, (disc.x[part], disc.y[part]), disc.radius[part])
        found.append((owner + start, x, y))
    owner, x, y = (np.concatenate(parts) for parts in zip(*found, strict=True))
    keep = _distinct(owner, x, y, 1e-9 * np.abs(camera[2] - point[2]))
    return owner[keep], x[keep], y[keep], unproven


def _cut(surface, path_slope, camera, point, middle, radius):
    """`every_path` of one chunk, with roots that neighbouring boxes share still repeated."""
    smallest = _SMALLEST * np.hypot(np.hypot(camera[0] - point[0], camera[1] - point[1]), camera[2] - point[2])
    unproven = ~np.isfinite(radius)
    owner = np.flatnonzero(~unproven)
    mid_x, mid_y = (c[owner] for c in middle)
    half_x = half_y = radius[owner]
    cut = np.zeros(radius.size, dtype=np.int64)
    roots = []
    while owner.size:
        cut += np.bincount(owner, minlength=cut.size)
        ends = tuple(c[owner] for c in camera), tuple(p[owner] for p in point)
        empty, single, lo, hi = _judge(surface, path_slope, *ends, (mid_x, mid_y), (half_x, half_y))
        if single.any():
            single_camera, single_point = (tuple(c[single] for c in end) for end in ends)
            at = _polished(
                surface, path_slope, single_camera, single_point,
                mid_x[single] + 0.5 * (lo[0] + hi[0])[single], mid_y[single] + 0.5 * (lo[1] + hi[1])[single],
            )  # fmt: skip
            roots.append((owner[single], *at))
        stuck = ~(empty | single) & ((np.maximum(half_x, half_y) < smallest[owner]) | (cut[owner] > _BUDGET))
        unproven[owner[stuck]] = True
        undecided = ~(empty | single) & ~unproven[owner]
        owner, mid_x, mid_y, half_x, half_y = _halved(
            owner[undecided],
            mid_x[undecided],
            mid_y[undecided],
            *(tuple(e[undecided] for e in end) for end in (lo, hi)),
        )
    if not roots:
        return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros(0), unproven
    owner, x, y = (np.concatenate(parts) for parts in zip(*roots, strict=True))
    return owner, x, y, unproven


def _judge(surface, path_slope, camera, point, middle, half):
    """Krawczyk test of boxes: which are empty, which hold one root, and their part that may hold roots."""
    (mid_x, mid_y), (half_x, half_y) = middle, half
    wide_x, wide_y = _OVERLAP * half_x, _OVERLAP * half_y
    # The corners are rounded: by far less than the overlap.
    box = Interval(mid_x - wide_x, mid_x + wide_x), Interval(mid_y - wide_y, mid_y + wide_y)
    over, (hxx, hxy, hyy) = path_slope(surface, camera, point, *box)
    (gx, gy), _ = path_slope(surface, camera, point, Interval(mid_x, mid_x), Interval(mid_y, mid_y))
    dx, dy = Interval(-wide_x, wide_x), Interval(-wide_y, wide_y)
    mean_x, mean_y = gx + hxx * dx + hxy * dy, gy + hxy * dx + hyy * dy
    # Y, the inverse of the Hessian in the middle of its enclosure; the operator is valid with any Y.
    cxx, cxy, cyy = (0.5 * (h.lo + h.hi) for h in (hxx, hxy, hyy))
    determinant = cxx * cyy - cxy * cxy
    yxx, yxy, yyy = cyy / determinant, -cxy / determinant, cxx / determinant
    k_x = (1.0 - (yxx * hxx + yxy * hxy)) * dx - (yxx * hxy + yxy * hyy) * dy - (yxx * gx + yxy * gy)
    k_y = (1.0 - (yxy * hxy + yyy * hyy)) * dy - (yxy * hxx + yyy * hxy) * dx - (yxy * gx + yyy * gy)
    # Where K is not a number (a singular Y, a leg of length zero in the box) fmax and fmin keep the whole box.
    lo = np.fmax(k_x.lo, -half_x), np.fmax(k_y.lo, -half_y)
    hi = np.fmin(k_x.hi, half_x), np.fmin(k_y.hi, half_y)
    empty = (lo[0] > hi[0]) | (lo[1] > hi[1])
    for gradient in (*over, mean_x, mean_y):
        empty |= gradient.misses_zero
    single = (k_x.magnitude < wide_x) & (k_y.magnitude < wide_y) & ~empty
    return empty, single, lo, hi


def _halved(owner, mid_x, mid_y, lo, hi):
    """The parts ``lo`` to ``hi`` of the boxes, cut in two across their longer side."""
    mid_x, mid_y = mid_x + 0.5 * (lo[0] + hi[0]), mid_y + 0.5 * (lo[1] + hi[1])
    half_x, half_y = 0.5 * (hi[0] - lo[0]), 0.5 * (hi[1] - lo[1])
    across = half_x >= half_y
    half_x, half_y = np.where(across, 0.5 * half_x, half_x), np.where(across, half_y, 0.5 * half_y)
    shift_x, shift_y = np.where(across, half_x, 0.0), np.where(across, 0.0, half_y)
    owner, half_x, half_y = (np.concatenate([a, a]) for a in (owner, half_x, half_y))
    mid_x, mid_y = (np.concatenate([m - s, m + s]) for m, s in ((mid_x, shift_x), (mid_y, shift_y)))
    return owner, mid_x, mid_y, half_x, half_y


def _polished(surface, path_slope, camera, point, x, y):
    """Newton's steps to the last bits, from the middle of the interval about the root."""
    for _ in range(_POLISH):
        (gx, gy), (hxx, hxy, hyy) = path_slope(surface, camera, point, x, y)
        determinant = hxx * hyy - hxy * hxy
        x, y = x + (hxy * gy - hyy * gx) / determinant, y + (hxy * gx - hxx * gy) / determinant
    return x, y


def _distinct(owner, x, y, near):
    """Indices of the roots, by owner, without those that a box shares with its neighbour."""
    order = np.lexsort((x, owner))
    keep: list[int] = []
    for i in order:
        own = takewhile(lambda j: owner[j] == owner[i], reversed(keep))  # noqa: B023 (used up at once)
        if all(np.hypot(x[i] - x[j], y[i] - y[j]) >= near[owner[i]] for j in own):
            keep.append(i)
    return np.array(keep, dtype=np.int64)


class Interval(NDArrayOperatorsMixin):
    """Arrays of closed intervals from ``lo`` to ``hi``, element by element."""

    def __init__(self, lo, hi):
        self.lo, self.hi = lo, hi

    def __array_ufunc__(self, ufunc, method, *inputs, **kwargs):
        rule = _RULES.get(ufunc)
        if rule is None or method != "__call__" or kwargs:
            return NotImplemented
        return rule(*(x if isinstance(x, Interval) else Interval(x, x) for x in inputs))

    @property
    def magnitude(self) -> np.ndarray:
        """The largest absolute value."""
        return np.maximum(np.abs(self.lo), np.abs(self.hi))

    @property
    def misses_zero(self) -> np.ndarray:
        """True where zero lies outside."""
        return (self.lo > 0.0) | (self.hi < 0.0)


def _outward(lo, hi) -> Interval:
    return Interval(lo - (_ULP * np.abs(lo) + _LEAST), hi + (_ULP * np.abs(hi) + _LEAST))


def _hull(*corners) -> Interval:
    lo, hi = corners[0], corners[0]
    for corner in corners[1:]:
        lo, hi = np.minimum(lo, corner), np.maximum(hi, corner)
    return _outward(lo, hi)


def _multiply(a: Interval, b: Interval) -> Interval:
    if a is b:  # a square is never negative
        low = np.where(a.misses_zero, np.minimum(np.abs(a.lo), np.abs(a.hi)), 0.0)
        return _outward(low * low, a.magnitude * a.magnitude)
    return _hull(a.lo * b.lo, a.lo * b.hi, a.hi * b.lo, a.hi * b.hi)


def _divide(a: Interval, b: Interval) -> Interval:
    if not np.all(b.misses_zero):
        b = Interval(np.where(b.misses_zero, b.lo, np.nan), np.where(b.misses_zero, b.hi, np.nan))
    return _hull(a.lo / b.lo, a.lo / b.hi, a.hi / b.lo, a.hi / b.hi)


def _sqrt(a: Interval) -> Interval:
    return _outward(np.sqrt(np.maximum(a.lo, 0.0)), np.sqrt(a.hi))


def _cos(a: Interval) -> Interval:
    """Plus or minus one where a multiple of pi, even or odd, may lie inside; else the ends decide."""
    turn = 2.0 * np.pi
    slack = 1e-15 * (1.0 + np.maximum(np.abs(a.lo), np.abs(a.hi)))  # multiples of pi and the quotient are rounded
    crests = np.floor((a.hi + slack) / turn) >= np.ceil((a.lo - slack) / turn)
    troughs = np.floor((a.hi + slack) / turn - 0.5) >= np.ceil((a.lo - slack) / turn - 0.5)
    first, last = np.cos(a.lo), np.cos(a.hi)
    low = np.where(troughs, -1.0, np.minimum(first, last) - _SINE_SLACK)
    high = np.where(crests, 1.0, np.maximum(first, last) + _SINE_SLACK)
    return Interval(low, high)


_QUARTER_TURN = Interval(np.nextafter(np.pi / 2.0, 0.0), np.nextafter(np.pi / 2.0, 2.0))


_RULES: dict[np.ufunc, Callable[..., Interval]] = {
    np.add: lambda a, b: _outward(a.lo + b.lo, a.hi + b.hi),
    np.subtract: lambda a, b: _outward(a.lo - b.hi, a.hi - b.lo),
    np.multiply: _multiply,
    np.divide: _divide,
    np.negative: lambda a: Interval(-a.hi, -a.lo),
    np.sqrt: _sqrt,
    np.cos: _cos,
    np.sin: lambda a: _cos(a - _QUARTER_TURN),
}
