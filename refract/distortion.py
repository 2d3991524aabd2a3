"""Distortion of a lens: from undistorted to distorted normalised coordinates in closed form, and back by Newton.

Normalised coordinates (x, y) are those of a ray at depth 1 in cam. One source for numpy, torch and Dr.Jit: numbers of a
lens are plain numbers, or arrays that hold those of another lens for each ray.

    row      eight coefficients, then the square of the reach, then the widest angle of a fisheye lens, -1 of an affine
             one, 0 for the others
    reach    greatest distance of (x, y) from the axis up to which the model is one to one; beyond it a polynomial may
             fold back, and the lens sees nothing
    kinds    of the lenses among the rays; terms of the others are left out
"""

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import final

import numpy as np

from refract._array import namespace

# Brown's polynomial k1 k2 p1 p2 k3; the same over another one, k1 k2 p1 p2 k3 k4 k5 k6; a polynomial of the angle to
# the axis, k1 k2 k3 k4. Order and sense of the coefficients are OpenCV's. Brown's polynomial with a term in the eighth
# power of the radius and a shear of x by y, k1 k2 p1 p2 k3 k4 skew, as Metashape has it.
BROWN, RATIONAL, FISHEYE, AFFINE = "brown", "rational", "fisheye", "affine"
_COUNTS = {BROWN: 5, RATIONAL: 8, FISHEYE: 4, AFFINE: 7}
_COEFFICIENTS = 8
ROW = _COEFFICIENTS + 2

# The farthest from the axis that a model is evaluated: a tangent of 8 (83 degrees), and 89 degrees for a fisheye lens.
_FARTHEST, _WIDEST = 8.0, math.radians(89.0)
_PLACES_TRIED, _SIDES_TRIED, _HALVINGS = 1600, 48, 50
# Newton's method doubles the digits with each step: five or six steps reach float64 in a usual lens; more are needed
# close to the reach.
STEPS, _MOST_STEPS = 8, 40
_ROUNDINGS = 100.0  # A solution is one where the residual is below this many units in the last place of 1
_JUST_INSIDE = 1.0 - 1e-6  # Newton's method keeps this much inside the reach, where the derivative is not zero yet
# The square of a distance from the axis below which a fisheye lens does not distort, in float32.
_ON_AXIS = 1e-14
_XP = namespace()
_BLOCK = 16384  # Rays at a time in numpy: their arrays stay in the cache


@final
@dataclass(frozen=True)
class Distortion:
    """The distortion of a lens.

    Raises ValueError if the kind is not known, or the number of coefficients is not that of the kind.
    """

    kind: str  # "brown", "rational", "fisheye" or "affine"
    # In OpenCV's order: k1 k2 p1 p2 k3 of brown, and k4 k5 k6 more of rational; k1 k2 k3 k4 of fisheye. Of affine
    # those of brown, k4 for the eighth power of the radius, and the skew: x grows by skew times y, both distorted
    coefficients: tuple[float, ...]

    def __post_init__(self):
        expected = _COUNTS.get(self.kind)
        if expected is None:
            raise ValueError(f"a distortion of kind {self.kind} is not known, expected one of {', '.join(_COUNTS)}")
        if len(self.coefficients) != expected or not all(map(math.isfinite, self.coefficients)):
            raise ValueError(f"expected {expected} finite coefficients of {self.kind}, got {self.coefficients}")

    @cached_property
    def reach(self) -> float:
        """Greatest distance from the axis, in normalised coordinates, that the lens sees."""
        return _reach(self.kind, self.coefficients)

    @cached_property
    def row(self) -> tuple[float, ...]:
        """The ten numbers that `distort` and `undistort` take."""
        padding = (0.0,) * (_COEFFICIENTS - len(self.coefficients))
        mark = {FISHEYE: math.atan(self.reach), AFFINE: -1.0}.get(self.kind, 0.0)
        return (*self.coefficients, *padding, self.reach**2, mark)

    def distorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distorted coordinates of undistorted ones, float64 of any shape; NaN beyond the reach."""
        with np.errstate(all="ignore"):
            return distort({self.kind}, x, y, self.row)

    def undistorted(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Undistorted coordinates of distorted ones, float64 of any shape; NaN where the lens sees nothing."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        found = np.empty((2, x.size))
        with np.errstate(all="ignore"):
            for first in range(0, x.size, _BLOCK):
                part = slice(first, first + _BLOCK)
                block = x.reshape(-1)[part], y.reshape(-1)[part]
                found[:, part] = undistort({self.kind}, *block, self.row, _MOST_STEPS)
        return found[0].reshape(x.shape), found[1].reshape(x.shape)


def row_of(distortion: Distortion | None) -> tuple[float, ...]:
    """The row of a distortion, or that of a lens without any."""
    return (0.0,) * _COEFFICIENTS + (math.inf, 0.0) if distortion is None else distortion.row


def kinds_of(distortions) -> frozenset[str]:
    """The kinds of some distortions, where None is a lens without any; empty if all are None.

    A lens without distortion is a polynomial of zeros, and a polynomial is a rational function over one, or an affine
    lens with two zeros.
    """
    distortions = list(distortions)
    kinds = {d.kind for d in distortions if d is not None}
    if FISHEYE in kinds and None in distortions:
        kinds.add(BROWN)
    return frozenset(kinds - {BROWN} if kinds & {RATIONAL, AFFINE} else kinds)


def distort(kinds, x, y, row) -> tuple:
    """Distorted coordinates of undistorted ones (x, y); NaN beyond the reach."""
    xp = namespace(x, y)
    r2 = xp.fma(x, x, y * y)
    within = r2 < row[8]
    if kinds == {FISHEYE}:
        scale = xp.where(within, _fisheye_scale(xp, r2, row), math.nan)
        return x * scale, y * scale
    radial, _ = _radial(xp, r2, row, kinds)
    p1, p2 = row[2], row[3]
    if FISHEYE in kinds:
        is_fisheye = row[9] > 0.0
        radial = xp.where(is_fisheye, _fisheye_scale(xp, r2, row), radial)
        p1, p2 = (xp.where(is_fisheye, 0.0, p) for p in (p1, p2))
    t = xp.where(within, 2.0 * xp.fma(y, p1, x * p2) + radial, math.nan)
    x, y = xp.fma(x, t, p2 * r2), xp.fma(y, t, p1 * r2)
    return (xp.fma(y, _of_affine(xp, row, kinds)[1], x), y) if AFFINE in kinds else (x, y)


def brown_with_derivatives(x, y, k1, k2, k3, p1, p2) -> tuple:
    """Coordinates (x, y) distorted by Brown's polynomial, the derivatives of both by x and y, and by the coefficients.

    Returns (x_d, y_d), (of x_d by x and by y, of y_d by x and by y), two tuples of five: of x_d and of y_d by k1 k2 k3
    p1 p2.
    """
    distorted, by_xy = _misfit(x, y, (0.0, 0.0), (k1, k2, p1, p2, k3), {BROWN})
    xx, yy, mixed = x * x, y * y, 2.0 * x * y
    r2 = xx + yy
    r4 = r2 * r2
    r6 = r4 * r2
    by_x = x * r2, x * r4, x * r6, mixed, r2 + 2.0 * xx
    by_y = y * r2, y * r4, y * r6, r2 + 2.0 * yy, mixed
    return distorted, by_xy, by_x, by_y


def undistort(kinds, x, y, row, steps: int = STEPS) -> tuple:
    """Undistorted coordinates of distorted ones (x, y), by Newton's method; NaN where the lens sees nothing.

    The lenses are of one kind.
    """
    if kinds == {FISHEYE}:
        return _undistort_fisheye(x, y, row, steps)
    return _undistort_polynomial(x, y, row, steps, kinds)


def _undistort_polynomial(x, y, row, steps: int, kinds) -> tuple:
    xp = namespace(x, y)
    if AFFINE in kinds:
        x = x - _of_affine(xp, row, kinds)[1] * y
    reach2 = row[8]
    tolerance = _ROUNDINGS * xp.eps(x)
    u, v = _drawn_in(xp, x, y, reach2)
    for _ in range(steps):
        (du, dv), (a, b, c, d) = _misfit(u, v, (x, y), row, kinds)
        if _all_small(xp, du, dv, tolerance):
            break
        over = 1.0 / (a * d - b * c)
        u, v = _drawn_in(xp, u - (d * du - b * dv) * over, v - (a * dv - c * du) * over, reach2)
    (du, dv), _ = _misfit(u, v, (x, y), row, kinds)
    solved = (xp.abs(du) + xp.abs(dv) < tolerance) & (xp.fma(u, u, v * v) < reach2)
    return xp.where(solved, u, math.nan), xp.where(solved, v, math.nan)


def _misfit(u, v, distorted, row, kinds) -> tuple:
    """Residual of (u, v), distorted, against ``distorted``, and the derivatives of both components by u and v."""
    xp, (x, y), p1, p2 = namespace(u, v), distorted, row[2], row[3]
    r2 = xp.fma(u, u, v * v)
    radial, slope = _radial(xp, r2, row, kinds)
    t = 2.0 * xp.fma(v, p1, u * p2) + radial
    t_u, t_v = 2.0 * xp.fma(u, slope, p2), 2.0 * xp.fma(v, slope, p1)
    du, dv = xp.fma(u, t, p2 * r2) - x, xp.fma(v, t, p1 * r2) - y
    by = (
        t + u * (t_u + 2.0 * p2), u * t_v + 2.0 * p2 * v,
        v * t_u + 2.0 * p1 * u, t + v * (t_v + 2.0 * p1),
    )  # fmt: skip
    return (du, dv), by


def _drawn_in(xp, u, v, reach2) -> tuple:
    """(u, v) moved back to the reach where it lies beyond."""
    r2 = xp.fma(u, u, v * v)
    factor = xp.where(r2 < reach2, 1.0, _JUST_INSIDE * xp.rsqrt(r2 / reach2))
    return u * factor, v * factor


def _all_small(xp, du, dv, tolerance) -> bool:
    """Whether Newton's method may stop; only numpy knows before the end."""
    return xp.name == "numpy" and bool(np.all(~(np.abs(du) + np.abs(dv) > 0.5 * tolerance)))


def _radial(xp, r2, row, kinds) -> tuple:
    """Factor of a polynomial or rational lens at the square of a radius, and its derivative by that square."""
    k1, k2, k3 = row[0], row[1], row[4]
    cubic, cubic_slope = k3, 3.0 * k3
    if AFFINE in kinds:
        fourth = _of_affine(xp, row, kinds)[0]
        cubic, cubic_slope = xp.fma(r2, fourth, k3), xp.fma(r2, 4.0 * fourth, 3.0 * k3)
    above = xp.fma(r2, xp.fma(r2, xp.fma(r2, cubic, k2), k1), 1.0)
    slope = xp.fma(r2, xp.fma(r2, cubic_slope, 2.0 * k2), k1)
    if RATIONAL not in kinds:
        return above, slope
    k4, k5, k6 = row[5], row[6], row[7]
    if AFFINE in kinds:
        is_affine = row[9] < 0.0
        k4, k5 = (xp.where(is_affine, 0.0, k) for k in (k4, k5))
    below = xp.fma(r2, xp.fma(r2, xp.fma(r2, k6, k5), k4), 1.0)
    slope_below = xp.fma(r2, xp.fma(r2, 3.0 * k6, 2.0 * k5), k4)
    factor = above / below
    return factor, (slope - factor * slope_below) / below


def _of_affine(xp, row, kinds) -> tuple:
    """The coefficient of the eighth power of the radius, and the skew; zeros for lenses of other kinds."""
    if RATIONAL not in kinds:
        # Of the other kinds these places of the row are zeros.
        return row[5], row[6]
    is_affine = row[9] < 0.0
    return xp.where(is_affine, row[5], 0.0), xp.where(is_affine, row[6], 0.0)


def _angle(xp, theta, row) -> tuple:
    """Distorted angle of a fisheye lens at an angle to its axis, and its derivative."""
    t2 = theta * theta
    k1, k2, k3, k4 = row[:4]
    factor = xp.fma(t2, xp.fma(t2, xp.fma(t2, xp.fma(t2, k4, k3), k2), k1), 1.0)
    slope = xp.fma(t2, xp.fma(t2, xp.fma(t2, xp.fma(t2, 9.0 * k4, 7.0 * k3), 5.0 * k2), 3.0 * k1), 1.0)
    return theta * factor, slope


def _fisheye_scale(xp, r2, row):
    """Distorted over undistorted distance from the axis of a fisheye lens."""
    far = r2 > _ON_AXIS
    r = xp.sqrt(xp.where(far, r2, 1.0))
    return xp.where(far, _angle(xp, xp.atan(r), row)[0] / r, 1.0)


def _undistort_fisheye(x, y, row, steps: int) -> tuple:
    xp = namespace(x, y)
    r2 = xp.fma(x, x, y * y)
    far = r2 > _ON_AXIS
    radius = xp.sqrt(xp.where(far, r2, 1.0))
    tolerance, widest = _ROUNDINGS * xp.eps(x), _JUST_INSIDE * row[9]
    theta = xp.minimum(radius, widest)
    for _ in range(steps):
        found, slope = _angle(xp, theta, row)
        theta = xp.maximum(xp.minimum(theta - (found - radius) / slope, widest), 0.0)
        if _all_small(xp, found - radius, 0.0, tolerance):
            break
    solved = xp.abs(_angle(xp, theta, row)[0] - radius) < tolerance
    scale = xp.where(far, xp.sin(theta) / (xp.cos(theta) * radius), 1.0)
    scale = xp.where(solved | ~far, scale, math.nan)
    return x * scale, y * scale


@lru_cache(maxsize=256)
@np.errstate(all="ignore")
def _reach(kind: str, coefficients: tuple[float, ...]) -> float:
    """The distance from the axis up to which a model is one to one on all sides, at most `_FARTHEST`."""
    row = (*coefficients, *(0.0,) * (_COEFFICIENTS - len(coefficients)))
    if kind == FISHEYE:
        return math.tan(_turn(lambda theta: _angle(_XP, theta, row)[1] > 0.0, _WIDEST))
    side = np.linspace(0.0, 2.0 * math.pi, _SIDES_TRIED, endpoint=False)[:, None]

    def one_to_one(r: np.ndarray) -> np.ndarray:
        u, v = r * np.cos(side), r * np.sin(side)
        over = row[5:] if kind == RATIONAL else (0.0, 0.0, 0.0)
        below = _radial(_XP, r * r, (0.0, 0.0, 0.0, 0.0, 0.0, *over), {RATIONAL})[0]
        _, (a, b, c, d) = _misfit(u, v, (0.0, 0.0), row, {kind})
        return ((a * d - b * c > 0.0) & (a + d > 0.0) & (below > 0.0)).all(axis=0)

    return _turn(one_to_one, _FARTHEST)


def _turn(holds, most: float) -> float:
    """The least positive place, at most ``most``, beyond which a condition on (N,) places fails."""
    places = np.linspace(0.0, most, _PLACES_TRIED + 1)
    failed = np.flatnonzero(~holds(places))
    if not len(failed):
        return most
    low, high = places[max(failed[0] - 1, 0)], places[failed[0]]
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if holds(np.array([middle]))[0] else (low, middle)
    return float(low)
