"""A measured water surface: triangles over a raster or over scattered points, with gaps where there is no water."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass, field
from functools import cached_property
from typing import Any, final

import numpy as np

from refract import _facet_paths, fermat, kernels
from refract._array import as_like, namespace
from refract._disc import Bounds
from refract._numbers import moved, number, plain, readable, require_index
from refract._triangulation import Triangulation

# Rounding of a clearance [m], as part of its size.
_ROUNDING = 1e-12
# A leg that has this part of its length to go has arrived.
_ARRIVED = 1e-9


@final
@dataclass(frozen=True, eq=False)
class HeightFieldWater:
    """Plane triangles between points of known height, in a right-handed frame with z up; numpy and torch.

    Between the points the surface is continuous and plane by parts: its normal changes at the edges. Over a raster of
    spacing s, of a smooth surface with curvature K, heights are good to ``K s^2 / 4`` and slopes to ``K s``.

    Parameters
    ----------
    points : (points, 2) [m], local
    heights : (points,) [m], local
        Of the water at the points; NaN where there is none. A triangle with such a corner is dry: rays pass through.
        A tensor lets gradients flow to the heights; the rays must then be tensors as well.
    triangles : (triangles, 3) int
        Corners, as places in `points`; together they fill the convex hull of the points.
    n_water : [-]
        Refractive index of the water relative to the air above it, at least 1.

    Raises
    ------
    ValueError
        If shapes do not fit, triangles overlap or leave gaps, none of them has water, or the index is outside 1 to 2.
    """

    points: Any
    heights: Any
    triangles: Any
    _: KW_ONLY
    n_water: Any = 1.333
    mesh: Triangulation = field(init=False, repr=False)

    def __post_init__(self):
        points = np.asarray(self.points, dtype=np.float64)
        shape = tuple(np.shape(self.heights))
        if points.ndim != 2 or points.shape[1] != 2 or shape != points.shape[:1]:
            raise ValueError(f"expected points (points, 2) and heights (points,), got {points.shape} and {shape}")
        object.__setattr__(self, "n_water", number(self.n_water))
        require_index(self.n_water)
        if namespace(self.heights).name == "numpy":
            object.__setattr__(self, "heights", np.asarray(self.heights, dtype=np.float64))
        mesh = Triangulation(points, self.triangles)
        object.__setattr__(self, "mesh", mesh)
        object.__setattr__(self, "points", mesh.points)
        object.__setattr__(self, "triangles", mesh.triangles)
        if not self.wet_triangles.any():
            raise ValueError("expected at least one triangle with three finite heights, got none")

    def to(self, *place, **options) -> HeightFieldWater:
        """The same water with its tensors moved, by the arguments of `torch.Tensor.to`."""
        return moved(self, place, options)

    @classmethod
    def from_raster(cls, x, y, heights, *, n_water=1.333) -> HeightFieldWater:
        """Water over a grid of nodes: two triangles per cell, cut from its corner of least x and y to the opposite one.

        Parameters
        ----------
        x : (columns,) [m], y : (rows,) [m], local
            Of the nodes; each is strictly monotonic.
        heights : (rows, columns) [m]
            At the nodes, not of cells; NaN where there is no water.

        Raises
        ------
        ValueError
            If the shapes do not fit, or x or y turns around.
        """
        x, y = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
        heights = heights if namespace(heights).name == "torch" else np.asarray(heights, dtype=np.float64)
        shape = tuple(heights.shape)
        if x.ndim != 1 or y.ndim != 1 or shape != (y.size, x.size) or min(shape) < 2:
            raise ValueError(
                f"expected heights (rows, columns), at least 2 each, with y (rows,) and x (columns,), "
                f"got {shape}, {y.shape} and {x.shape}"
            )
        for name, axis in (("x", x), ("y", y)):
            steps = np.diff(axis)
            if not (np.all(steps > 0.0) or np.all(steps < 0.0)):
                raise ValueError(f"expected {name} to rise or fall all the way, got {axis}")
        x_order, y_order = np.argsort(x), np.argsort(y)
        index = np.arange(x.size * y.size).reshape(shape)[y_order][:, x_order]
        low_left, low_right, up_left, up_right = (
            index[r, c].ravel() for r in (slice(None, -1), slice(1, None)) for c in (slice(None, -1), slice(1, None))
        )
        triangles = np.concatenate(
            [np.stack([low_left, low_right, up_right], -1), np.stack([low_left, up_right, up_left], -1)]
        )
        points = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        return cls(points, heights.reshape(-1), triangles, n_water=n_water)

    @classmethod
    def from_points(cls, points, heights, *, n_water=1.333) -> HeightFieldWater:
        """Water over scattered points (points, 2) [m], local, with heights (points,) [m], by Delaunay's triangles."""
        from scipy.spatial import Delaunay

        points = np.asarray(points, dtype=np.float64)
        return cls(points, heights, Delaunay(points).simplices, n_water=n_water)

    @cached_property
    def plain_heights(self) -> np.ndarray:
        """The heights in numpy, without gradients."""
        return readable(self.heights)

    @cached_property
    def wet_triangles(self) -> np.ndarray:
        """(triangles,) bool: all three corners have water."""
        return np.isfinite(self.plain_heights[self.triangles]).all(axis=-1)

    @cached_property
    def _steepest(self) -> float:
        """Largest slope of a triangle, with missing heights filled from the nearest point that has one.

        Filled, the surface leads from any wet triangle to any other, and two of its points differ by no more than
        this slope times their distance.
        """
        known = np.isfinite(self.plain_heights)
        filled = self.plain_heights.copy()
        if not known.all():
            from scipy.spatial import cKDTree

            near = cKDTree(self.points[known]).query(self.points[~known])[1]
            filled[~known] = self.plain_heights[known][near]
        slope_x, slope_y = _slopes(self.points[self.triangles], filled[self.triangles])
        return float(np.hypot(slope_x, slope_y).max())

    @cached_property
    def _plain(self) -> HeightFieldWater:
        if namespace(self.heights, self.n_water).name == "numpy":
            return self
        return HeightFieldWater(self.points, self.plain_heights, self.triangles, n_water=plain(self.n_water))

    def detached(self) -> HeightFieldWater:
        """The same water in numpy, without gradients."""
        return self._plain

    @cached_property
    def kinks(self) -> _facet_paths.Kinks:
        """The edges and corners where a shortest path may end up."""
        return _facet_paths.Kinks(self)

    def bounds(self, x, y, radius) -> Bounds:
        """Bounds of the whole surface; the curvature, which an edge makes infinite, is not used."""
        wet = self.plain_heights[self.triangles[self.wet_triangles]]
        return Bounds(x * 0.0 + wet.min(), x * 0.0 + wet.max(), self._steepest, math.inf)

    def planes(self, triangle, like):
        """A corner (x, y, z) and the slopes along x and y of the planes of triangles; in the library of `like`."""
        corners = self.points[self.triangles[triangle]]
        if namespace(like).name == "torch":
            z = (self.heights if namespace(self.heights).name == "torch" else as_like(self.heights, like))[
                as_like(self.triangles[triangle], like).long()
            ].to(like.dtype)
            corners = as_like(corners, like)
        else:
            z = self.plain_heights[self.triangles[triangle]]
        return (corners[..., 0, 0], corners[..., 0, 1], z[..., 0]), _slopes(corners, z)

    def or_any(self, triangle):
        """`triangle` where there is one, elsewhere some wet one: its numbers are harmless, also to gradients."""
        return np.where(triangle >= 0, triangle, self.wet_triangles.argmax())

    def _under(self, x, y):
        """The wet triangle over or under each point, numpy; -1 where there is none."""
        x, y = np.broadcast_arrays(readable(x), readable(y))
        triangle, inside = self.mesh.locate(x.ravel(), y.ravel())
        return np.where(inside & self.wet_triangles[triangle], triangle, -1).reshape(x.shape)

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]; NaN where there is no water."""
        _needs_numpy_or_torch(x)
        triangle = self._under(x, y)
        (cx, cy, cz), (slope_x, slope_y) = self.planes(self.or_any(triangle), x)
        z = cz + slope_x * (x - cx) + slope_y * (y - cy)
        return namespace(x).where(as_like(triangle, x) >= 0, z, math.nan)

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the triangle at x, y, pointing up into the air; NaN where there is no water."""
        _needs_numpy_or_torch(x)
        xp, triangle = namespace(x), self._under(x, y)
        _, (slope_x, slope_y) = self.planes(self.or_any(triangle), x)
        up = 1.0 / xp.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        wet = as_like(triangle, x) >= 0
        return tuple(xp.where(wet, c, math.nan) for c in (-slope_x * up, -slope_y * up, up))

    def intersect(self, origin, direction):
        """Distance [m] to the first meeting with the surface along unit rays from above; NaN where there is none.

        Exact: a walk from triangle to triangle under the ray, each of them a plane.
        """
        _needs_numpy_or_torch(origin[0])
        like = origin[0] + direction[0]
        origin, direction = fermat.together(origin, direction)
        xp = namespace(*origin)
        plain_origin, plain_direction = (tuple(readable(c).ravel() for c in v) for v in (origin, direction))
        met = self._first_triangle(plain_origin, plain_direction, 1.0)
        met = met.reshape(tuple(origin[0].shape))
        corner, slopes = self.planes(self.or_any(met), origin[0])
        meets = as_like(met, origin[0]) >= 0
        over, rate = _clearance(corner, slopes, origin, direction)
        t = -over / xp.where(meets, rate, -1.0)
        return xp.like(xp.where(meets, xp.maximum(t, 0.0), math.nan), like)

    def _first_triangle(self, origin, direction, side):
        """The triangle where rays from above (side 1) or below (-1) first meet the surface; -1 for none (numpy)."""
        met = np.full(origin[0].shape, -1)
        wet = self.plain_heights[self.triangles[self.wet_triangles]]
        level = wet.max() if side > 0.0 else wet.min()
        fall = side * direction[2]
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            start, end = self.mesh.span(*origin[:2], *direction[:2])
            over = side * (origin[2] - level)
            start = np.maximum(start, np.where(over > 0.0, np.where(fall < 0.0, over / -fall, np.inf), 0.0))
            left = np.flatnonzero((start <= end) & np.isfinite(start))
            here = tuple((o + start * d)[left] for o, d in zip(origin[:2], direction[:2], strict=True))
            triangle, _ = self.mesh.locate(*here)
            enters = np.ones(left.size, dtype=bool)
            t = start[left]
            for _ in range(len(self.triangles)):
                o, d = (tuple(c[left] for c in v) for v in (origin, direction))
                leave, behind = self.mesh.exit(triangle, *o[:2], *d[:2])
                leave = np.maximum(leave, t)
                corner, slopes = self.planes(triangle, t)
                over, rate = (side * v for v in _clearance(corner, slopes, o, d))
                hit = (over + np.where(np.isfinite(leave), leave, 0.0) * rate <= 0.0) & np.isfinite(leave)
                hit |= np.isinf(leave) & (rate < 0.0)
                # A ray that comes in from dry land below the level of the water never meets it from its own side.
                sunk = enters & (over + t * rate < -_ROUNDING * (1.0 + np.abs(over)))
                met[left[hit & ~sunk]] = triangle[hit & ~sunk]
                enters = ~self.wet_triangles[triangle]
                going = ~hit & ~sunk & (behind >= 0)
                left, triangle, enters, t = left[going], behind[going], enters[going], leave[going]
                if left.size == 0:
                    break
        return met

    def clear(self, camera, crossing, point):
        """True where neither leg to the crossing meets the surface before it gets there (numpy)."""
        clear = np.ones(crossing[0].shape, dtype=bool)
        for end, side in ((camera, 1.0), (point, -1.0)):
            way = kernels.minus(crossing, end)
            length = np.sqrt(kernels.dot(way, way))
            flat = np.abs(way[2]) <= self._steepest * np.hypot(way[0], way[1])
            origin, direction = tuple(c[flat] for c in end), tuple((w / length)[flat] for w in way)
            met = self._first_triangle(origin, direction, side)
            corner, slopes = self.planes(self.or_any(met), origin[0])
            over, rate = _clearance(corner, slopes, origin, direction)
            with np.errstate(divide="ignore", invalid="ignore"):
                first = np.where(met >= 0, -over / rate, np.inf)
            clear[flat] = first >= length[flat] * (1.0 - _ARRIVED)
        return clear

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`: the shortest of all paths through plane triangles (`refract._facet_paths`)."""
        _needs_numpy_or_torch(point[0])
        return _facet_paths.crossing(self, camera, point)


def _slopes(corners, z):
    """Slopes along x and y of planes through corners (..., 3, 2) at heights z (..., 3)."""
    way = corners[..., 1:, :] - corners[..., :1, :]
    ax, ay, bx, by = way[..., 0, 0], way[..., 0, 1], way[..., 1, 0], way[..., 1, 1]
    rise_a, rise_b = z[..., 1] - z[..., 0], z[..., 2] - z[..., 0]
    area = ax * by - ay * bx
    return (rise_a * by - rise_b * ay) / area, (rise_b * ax - rise_a * bx) / area


def _clearance(corner, slopes, origin, direction):
    """Height [m] of the start of rays over planes, and its rate along the ray [-]."""
    over = origin[2] - corner[2] - slopes[0] * (origin[0] - corner[0]) - slopes[1] * (origin[1] - corner[1])
    return over, direction[2] - slopes[0] * direction[0] - slopes[1] * direction[1]


def _needs_numpy_or_torch(array):
    if namespace(array).name == "drjit":
        raise TypeError(
            "HeightFieldWater runs on numpy and torch, got Dr.Jit arrays; convert them, or take FlatWater, WavyWater "
            "or SphericalWater, which run on Dr.Jit"
        )
