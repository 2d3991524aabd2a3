"""Water surfaces: the small interface that all of them share, and the plane.

Everything here speaks in triples ``(x, y, z)`` of component arrays of any one library, as `refract.kernels` does;
`refract.trace` and `refract.project` take and give arrays of vectors.
"""

import math
from dataclasses import KW_ONLY, dataclass
from typing import Any, Protocol, final

import numpy as np

from refract import kernels
from refract._array import components, hold, in_library, namespace, number, require_index, root
from refract.kernels import GRAZING

# Steps of `kernels.air_share` that reach the last bits for all heights, depths and distances (docs/optics.md).
ENOUGH_STEPS_SINGLE, ENOUGH_STEPS_DOUBLE = 3, 4


class WaterSurface(Protocol):
    """Protocol of a water surface for `trace` and `project`, in the local frame [m].

    Component arrays are numpy float64 or torch; where an answer is the same everywhere it may be a plain
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

        Finite and at least zero; NaN where a ray never meets it. Callers never pass rays that start below.
        """

    def crossing(self, camera, point, steps: int) -> tuple[tuple[Any, Any, Any], Any]:
        """Crossing of the surface through which a camera sees a point, and the depth of the point below the surface.

        The depth is along the normal of a plane, vertical for a curved surface. A point that is not below the surface,
        and every point for a camera that is not above it, is its own crossing: the ray is straight. At most `steps`
        steps are taken, where a surface takes steps. The answer may be in a higher precision than the arguments;
        `project` rounds it once.
        """


def require_surface(surface) -> None:
    """TypeError unless `trace` and `project` can take this surface."""
    if surface is not None and not hasattr(surface, "intersect"):
        raise TypeError(f"expected FlatWater, another WaterSurface or None, got {type(surface).__name__}")


def height_over(surface: WaterSurface, position):
    """Signed height of a position over a surface: along the normal of a plane, vertical over any other."""
    if not isinstance(surface, FlatWater):
        return position[2] - surface.height(position[0], position[1])
    point, up, _ = surface.plane(position)
    return kernels.height_over_plane(_across(position, up), _across(point, up), up)


def _across(triple, up):
    """The components of a triple that the height over a plane depends on, in float64."""
    return tuple(
        v if type(m) is float and m == 0.0 else namespace(v).double(v) for v, m in zip(triple, up, strict=True)
    )


def derivable(surface: WaterSurface | None, *arrays) -> bool:
    """Whether rays or surface may carry derivatives, or the surface requires valid numbers everywhere."""
    xp = namespace(*arrays)
    plain = surface is None or (isinstance(surface, FlatWater) and surface.is_plain)
    return not plain if xp.name == "numpy" else not plain or xp.tracked(*arrays)


def _up(slope_x, slope_y) -> tuple[Any, Any, Any]:
    """Unit normal of a plane with these slopes."""
    length = root(1.0 + slope_x * slope_x + slope_y * slope_y)
    return -slope_x / length, -slope_y / length, 1.0 / length


@final
@dataclass(frozen=True)
class FlatWater:
    """A plane water surface, level or tilted, in a right-handed frame with z up.

    Each of its numbers is one for all rays, or an array of shape (...) with one for each, which broadcasts against the
    rays without their last axis: a level per photograph, or, with one more axis, an index per colour channel. Tensors
    let gradients flow to level, tilt and index; the rays must then be tensors, too. Raises ValueError if the index is
    outside 1 to 2, or a number is not finite. Numbers inside a transform of torch, which cannot be read, are not
    checked.
    """

    point: tuple[Any, Any, Any]  # (3,) [m], local: any point of the surface
    _: KW_ONLY
    n_water: Any = 1.333  # [-]: refractive index of the water relative to the air above it, at least 1
    # slope_x, slope_y [-]: rise of the surface per metre along local x and y
    slope_x: Any = 0.0
    slope_y: Any = 0.0

    def __post_init__(self):
        object.__setattr__(self, "point", tuple(number(v) for v in self.point))
        for name in ("n_water", "slope_x", "slope_y"):
            object.__setattr__(self, name, number(getattr(self, name)))
        if len(self.point) != 3 or not hold(np.isfinite, *self._numbers):
            raise ValueError(
                f"expected three finite coordinates, a finite index and two finite slopes, got {self._numbers}"
            )
        require_index(self.n_water)

    @property
    def _numbers(self) -> tuple:
        return (*self.point, self.n_water, self.slope_x, self.slope_y)

    @property
    def up(self) -> tuple[Any, Any, Any]:
        """Unit normal of the plane, pointing up into the air, local."""
        return _up(self.slope_x, self.slope_y)

    @property
    def is_plain(self) -> bool:
        """Whether all parameters are plain numbers, so that there is nothing to differentiate."""
        return all(isinstance(v, float) for v in self._numbers)

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """`up`, whatever x and y."""
        return _up(in_library(self.slope_x, x), in_library(self.slope_y, x))

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]."""
        px, py, pz, _, slope_x, slope_y = (in_library(v, x) for v in self._numbers)
        return pz + slope_x * (x - px) + slope_y * (y - py)

    def depth(self, points):
        """Depth below the surface [m] along its normal, positive in water, of points (..., 3) [m], local."""
        position = components(points)
        point, up, _ = self.plane(position)
        return -kernels.height_over_plane(position, point, up)

    def plane(self, *triples) -> tuple:
        """Point, unit normal and index, as the kernels take them together with triples of arrays.

        Raises TypeError if the numbers of the water and the triples are arrays of different libraries; ValueError if
        shapes of numbers do not broadcast against those of numpy or torch rays.
        """
        own, like = {namespace(v).name for v in self._numbers} - {"numpy"}, triples[0][0]
        if own and own != (given := {namespace(v).name for triple in triples for v in triple}):
            raise TypeError(
                f"numbers of this FlatWater are arrays of {', '.join(sorted(own))}, rays and points of "
                f"{', '.join(sorted(given))}; take both from one library"
            )
        if self.is_plain:
            return self.point, self.up, self.n_water
        shapes = [tuple(v.shape) for v in (like, *self._numbers) if hasattr(v, "shape")]
        try:
            np.broadcast_shapes(*shapes)
        except ValueError:
            raise ValueError(
                f"expected numbers of the water that broadcast against rays {shapes[0]} (without their last axis), got "
                f"{shapes[1:]}; give rays one more axis for an index per channel: rays[..., None, :]"
            ) from None
        if not any(isinstance(v, np.ndarray) for v in self._numbers):
            return self.point, self.up, self.n_water
        x, y, z, n_water, slope_x, slope_y = (in_library(v, like) for v in self._numbers)
        return (x, y, z), _up(slope_x, slope_y), n_water

    def intersect(self, origin, direction):
        """Distance [m] to the plane along rays that fall toward it from above; NaN for the others.

        In float64 even for rays in float32: far from its point, a tilted plane needs more digits.
        """
        point, up, _ = self.plane(origin, direction)
        origin, direction, point = (_across(v, up) for v in (origin, direction, point))
        H, falling = kernels.height_over_plane(origin, point, up), -kernels.dot(direction, up)
        meets = (falling > GRAZING) & (H >= 0.0)
        select = kernels.selector(meets)
        return select(H / select(falling, 1.0), math.nan)

    def legs(self, camera, point, steps: int):
        """The legs of the path from camera to point, and the depth of the point; in float64."""
        return self._solved(kernels.legs_of_point, camera, point, steps)

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`. Answers in float64."""
        return self._solved(kernels.crossing_of_point, camera, point, steps)

    def _solved(self, kernel, camera, point, steps: int) -> tuple:
        single = namespace(*point).eps(point[0]) > 1e-10
        enough = ENOUGH_STEPS_SINGLE if single else ENOUGH_STEPS_DOUBLE
        plane_point, up, n_water = self.plane(camera, point)
        plane = kernels.WaterPlane(kernels.double(plane_point), kernels.double(up), kernels.double((n_water,))[0])
        camera, point_64 = kernels.double(camera), kernels.double(point)
        return kernel(camera, point_64, plane, min(steps, enough), like=point[0] if single else None)
