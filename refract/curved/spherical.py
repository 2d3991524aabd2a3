"""Still water over a large area: a sphere of the local radius of the Earth."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, final

import numpy as np

from refract import kernels
from refract._array import namespace
from refract._numbers import hold, moved, number, of_any_size, plain, require_index
from refract._solvers import solved
from refract.curved import fermat
from refract.curved._disc import Bounds
from refract.kernels import GRAZING

MEAN_RADIUS_M = 6_371_000.0
# WGS 84: semi-major axis [m] and flattening.
_WGS84_A, _WGS84_F = 6_378_137.0, 1.0 / 298.257223563


@of_any_size
def curvature_drop(distance, radius=MEAN_RADIUS_M):
    """Drop of a level surface below its tangent plane [m], ``distance`` [m] from where they touch.

    ``R - sqrt(R^2 - d^2)``, written without the difference: 2.0 cm at 500 m, 7.8 cm at 1 km. NaN beyond the radius.
    """
    return _drop(distance * distance, radius)


def _drop(square, radius):
    """`curvature_drop` from the squared distance, which is smooth also where the distance is zero."""
    xp = namespace(square)
    room = radius * radius - square
    inside = room > 0.0
    drop = square / (radius + xp.sqrt(xp.where(inside, room, room * 0.0 + 1.0)))
    return xp.where(inside, drop, drop * 0.0 + float("nan"))


def gaussian_radius(latitude: float) -> float:
    """Gaussian radius of curvature of the WGS 84 ellipsoid [m] at a geodetic latitude [rad].

    The geometric mean of the two principal radii, ``a sqrt(1 - e^2) / (1 - e^2 sin^2 latitude)`` (Torge and Mueller,
    Geodesy, 4th ed., 4.1): the sphere that fits best in all directions.
    """
    e_squared = _WGS84_F * (2.0 - _WGS84_F)
    return _WGS84_A * math.sqrt(1.0 - e_squared) / (1.0 - e_squared * math.sin(latitude) ** 2)


@solved
@final
@dataclass(frozen=True)
class SphericalWater:
    """A sphere that touches the level plane z = point[2] at a point; a right-handed frame with z up there.

    Parameters
    ----------
    point : (3,) [m], local
        Where the surface is level, the origin of a topocentric frame in x and y.
    radius : [m]
        Of the Earth: `gaussian_radius` of the latitude; may be a 0-d tensor, as may all the numbers.
    n_water : [-]
        Refractive index of the water relative to the air above it, at least 1.

    Raises
    ------
    ValueError
        If the radius is not positive, the index is outside 1 to 2, or a number is not finite.

    Notes
    -----
    The surface ends, as NaN, half a radius from the point: beyond, a height over x and y has no meaning.
    """

    point: tuple[Any, Any, Any]
    radius: Any = MEAN_RADIUS_M
    _: KW_ONLY
    n_water: Any = 1.333

    def __post_init__(self):
        object.__setattr__(self, "point", tuple(number(v) for v in self.point))
        object.__setattr__(self, "radius", number(self.radius))
        object.__setattr__(self, "n_water", number(self.n_water))
        own = self.numbers
        if len(self.point) != 3 or not hold(np.isfinite, *own) or not hold(lambda r: r > 0.0, self.radius):
            raise ValueError(f"expected three finite coordinates, a positive radius and a finite index, got {own}")
        require_index(self.n_water)

    def to(self, *place, **options) -> SphericalWater:
        """The same water with its tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    @property
    def numbers(self) -> tuple:
        """All numbers of the sphere in one row."""
        return (*self.point, self.radius, self.n_water)

    @classmethod
    def from_numbers(cls, x, y, z, radius, n_water) -> SphericalWater:
        """The sphere with these `numbers`."""
        return cls((x, y, z), radius, n_water=n_water)

    def detached(self) -> SphericalWater:
        """The same water in plain numbers, without gradients."""
        return SphericalWater.from_numbers(*map(plain, self.numbers))

    def derivatives(self, x, y) -> tuple:
        """Height [m], slopes along x and y [-] and second derivatives xx, xy, yy [1/m] at local x, y [m]."""
        xp = namespace(x, y)
        rx, ry = x - self.point[0], y - self.point[1]
        square = rx * rx + ry * ry
        up = xp.sqrt(self.radius * self.radius - square)  # of the point over the centre of the sphere
        per_up = 1.0 / up
        zx, zy = -rx * per_up, -ry * per_up
        z = self.point[2] - square / (self.radius + up)
        return z, zx, zy, -(1.0 + zx * zx) * per_up, -zx * zy * per_up, -(1.0 + zy * zy) * per_up

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]; NaN farther than half a radius from the point."""
        xp = namespace(x, y)
        rx, ry = x - self.point[0], y - self.point[1]
        square = rx * rx + ry * ry
        inside = square < 0.25 * self.radius * self.radius
        z = self.point[2] - _drop(square, self.radius)
        return xp.where(inside, z, z * 0.0 + float("nan"))

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the surface at x, y, pointing up into the air; NaN beyond the radius."""
        xp = namespace(x, y)
        nx, ny = (x - self.point[0]) / self.radius, (y - self.point[1]) / self.radius
        left = 1.0 - nx * nx - ny * ny
        inside = left > 0.0
        return tuple(xp.where(inside, c, math.nan) for c in (nx, ny, xp.sqrt(xp.where(inside, left, 1.0))))

    def bounds(self, x, y, radius) -> Bounds:
        """Bounds over a disc: the slope and curvature of its farthest rim; infinite where it leaves the surface."""
        xp = namespace(x, y)
        middle = xp.sqrt((x - self.point[0]) ** 2 + (y - self.point[1]) ** 2)
        far, near = middle + radius, xp.maximum(middle - radius, 0.0)
        inside = far < 0.5 * self.radius
        far, near = xp.where(inside, far, 0.0), xp.where(inside, near, 0.0)
        up = xp.sqrt(self.radius * self.radius - far * far)
        slope, curvature = far / up, self.radius * self.radius / (up * up * up)
        low, high = (self.point[2] - _drop(distance * distance, self.radius) for distance in (far, near))
        endless = far * 0.0 + float("inf")
        return Bounds(
            xp.where(inside, low, -endless), xp.where(inside, high, endless),
            xp.where(inside, slope, endless), xp.where(inside, curvature, endless),
        )  # fmt: skip

    def anchor(self) -> tuple:
        """Some x, y where the surface is defined."""
        return plain(self.point[0]), plain(self.point[1])

    def clear(self, camera, crossing, point):
        """Always true: a sphere is convex, a leg that comes from its own side meets it once."""
        return crossing[0] == crossing[0]

    def intersect(self, origin, direction):
        """Distance [m] to the sphere along unit rays from above, in closed form; NaN where they miss it.

        The root of ``t^2 + 2 b t + c = 0`` with the smaller t, as ``c / (sqrt(b^2 - c) - b)``: no digits are lost,
        although b and c count from the far centre of the Earth (``c = 2 R z + |o|^2`` with z over the tangent plane).
        """
        like = origin[0] + direction[0]
        origin, direction = kernels.double(origin), kernels.double(direction)
        xp = namespace(*origin, *direction)
        ox, oy, oz = (o - p for o, p in zip(origin, self.point, strict=True))
        b = ox * direction[0] + oy * direction[1] + (oz + self.radius) * direction[2]
        c = ox * ox + oy * oy + (oz + 2.0 * self.radius) * oz
        room = b * b - c
        falls = -b > GRAZING * self.radius
        meets = falls & (c >= 0.0) & (room > 0.0)
        t = c / (xp.sqrt(xp.where(meets, room, room * 0.0 + 1.0)) + xp.where(meets, -b, b * 0.0 + 1.0))
        return xp.like(xp.where(meets, t, math.nan), like)

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`: one path, by Newton's steps on a length that is proven convex."""
        return fermat.crossing(self, camera, point)
