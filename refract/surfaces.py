"""Water surfaces: the small interface that all of them share, and the plane.

Everything here speaks in triples ``(x, y, z)`` of component arrays of any one library, as `refract.kernels` does;
`refract.trace` and `refract.project` take and give arrays of vectors.
"""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol, final

import numpy as np

from refract import kernels
from refract._array import as_numpy, namespace, root
from refract.kernels import GRAZING

# Of `kernels.air_share`, for the last bits over all heights, depths and distances (docs/optics.md).
ENOUGH_STEPS_SINGLE, ENOUGH_STEPS_DOUBLE = 3, 4


class WaterSurface(Protocol):
    """What `trace` and `project` ask of a water surface, in the local frame [m].

    Component arrays are numpy float64, torch or Dr.Jit; where an answer is the same everywhere it may be a plain
    number, which broadcasts.
    """

    @property
    def n_water(self) -> Any:
        """Refractive index of the water relative to the air above it [-]."""

    def height(self, x, y):
        """Height z of the surface at x, y."""

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the surface at x, y, pointing up into the air."""

    def intersect(self, origin, direction):
        """Distance along rays (unit directions) to their first meeting with the surface from above.

        Finite and at least zero; NaN where a ray never meets it. Rays that start below are never passed.
        """

    def crossing(self, camera, point, steps: int) -> tuple[tuple[Any, Any, Any], Any, Any]:
        """The way back up: where a camera sees a point through the surface.

        Returns the crossing, the depth of the point below the surface (along the normal of a plane, vertical for
        a curved surface) and the number of stationary paths, from which the one of least optical length was
        taken. A point that is not below the surface, and every point for a camera that is not above it, is its own
        crossing: the ray is straight. At most `steps` steps are taken, where a surface takes steps. The answer may be
        in a higher precision than the arguments; `project` rounds it once.
        """


def _number(value):
    """A plain number as float; a 0-d tensor or a Dr.Jit scalar, which may carry gradients, as it is."""
    return value if namespace(value).name != "numpy" else float(value)


def _plain(value) -> float:
    """The value of a number of any library, without its gradient."""
    return as_numpy(value).item()


def _library(value) -> str:
    """The library of an array; for Dr.Jit its module, since arrays without gradients are of another one."""
    name = namespace(value).name
    return type(value).__module__ if name == "drjit" else name


@final
@dataclass(frozen=True)
class FlatWater:
    """A plane water surface, level or tilted, in a right-handed frame with z up.

    Its numbers may be 0-d tensors or Dr.Jit scalars: gradients then flow to level, tilt and index, and the rays
    must come from the same library (and the same Dr.Jit module: `drjit.llvm.ad`, not `drjit.llvm`).

    Parameters
    ----------
    point : (3,) [m], local
        Any point of the surface.
    n_water : [-]
        Refractive index of the water relative to the air above it, at least 1.
    slope_x, slope_y : [-]
        Rise of the surface per metre along local x and y.

    Raises
    ------
    ValueError
        If the index is outside 1 to 2, or a number is not finite.
    """

    point: tuple[Any, Any, Any]
    _: KW_ONLY
    n_water: Any = 1.333
    slope_x: Any = 0.0
    slope_y: Any = 0.0

    def __post_init__(self):
        object.__setattr__(self, "point", tuple(_number(v) for v in self.point))
        for name in ("n_water", "slope_x", "slope_y"):
            object.__setattr__(self, name, _number(getattr(self, name)))
        numbers = tuple(_plain(v) for v in (*self.point, self.n_water, self.slope_x, self.slope_y))
        if len(self.point) != 3 or not all(math.isfinite(v) for v in numbers):
            raise ValueError(f"expected three finite coordinates, a finite index and two finite slopes, got {numbers}")
        index = _plain(self.n_water)
        if not 1.0 <= index <= 2.0:
            raise ValueError(f"expected an index of water relative to air of 1 to 2 (fresh: 1.333), got {index}")

    @property
    def up(self) -> tuple[Any, Any, Any]:
        """Unit normal of the plane, pointing up into the air, local."""
        length = root(1.0 + self.slope_x * self.slope_x + self.slope_y * self.slope_y)
        return (-self.slope_x / length, -self.slope_y / length, 1.0 / length)

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """`up`, whatever x and y."""
        return self.up

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]."""
        return self.point[2] + self.slope_x * (x - self.point[0]) + self.slope_y * (y - self.point[1])

    def depth(self, points):
        """Depth below the surface [m] along its normal, positive in water, of points (..., 3) [m], local."""
        nx, ny, nz = self.up
        px, py, pz = self.point
        return -((points[..., 0] - px) * nx + (points[..., 1] - py) * ny + (points[..., 2] - pz) * nz)

    def _require_library_of(self, *triples) -> None:
        """TypeError unless rays come from where the numbers of the water do, if those are not plain."""
        numbers = (*self.point, self.n_water, self.slope_x, self.slope_y)
        own = {_library(v) for v in numbers} - {"numpy"}
        given = {_library(v) for triple in triples for v in triple}
        if own and own != given:
            raise TypeError(
                f"numbers of this FlatWater are arrays of {', '.join(sorted(own))}, rays and points of "
                f"{', '.join(sorted(given))}; take both from one library"
            )

    def intersect(self, origin, direction):
        """Distance [m] to the plane along rays that fall toward it from above; NaN for the others."""
        self._require_library_of(origin, direction)
        xp = namespace(*origin, *direction)
        H = kernels.dot(tuple(c - p for c, p in zip(origin, self.point, strict=True)), self.up)
        falling = -kernels.dot(direction, self.up)
        meets = (falling > GRAZING) & (H >= 0.0)
        t = H / xp.where(meets, falling, falling * 0.0 + 1.0)
        return xp.where(meets, t, t * 0.0 + float("nan"))

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`; a plane has one stationary path. Answers in float64."""
        self._require_library_of(camera, point)
        single = namespace(*point).eps(point[0]) > 1e-10
        enough = ENOUGH_STEPS_SINGLE if single else ENOUGH_STEPS_DOUBLE
        ends = (camera, point, self.point, self.up, (self.n_water,))
        fine_camera, fine_point, plane, up, (n_water,) = (kernels.double(v) for v in ends)
        crossing, depth = kernels.crossing_of_point(
            fine_camera, fine_point, plane, up, n_water, min(steps, enough), like=point[0] if single else None
        )
        return crossing, depth, 1

    def as_array(self) -> np.ndarray:
        """Point, normal and index as (7,) float64, the form that compiled kernels take."""
        return np.array([_plain(v) for v in (*self.point, *self.up, self.n_water)], dtype=np.float64)
