"""A measured water surface: triangles over a raster or over scattered points, with gaps where there is no water."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from functools import cached_property, lru_cache
from typing import Any, final

import numpy as np

from refract._array import alike, as_like, as_numpy, compiling, namespace, transformed
from refract._numbers import moved, number, plain, read, require_index
from refract._solvers import solved
from refract.curved import _facet_paths, _triangulation, fermat
from refract.curved._disc import Bounds
from refract.curved._triangulation import Triangulation

# Cached triangulations: a surface whose heights change keeps its triangulation.
_KEPT = 2


@solved
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
        Corners, as indices into `points`; together they fill the convex hull of the points.
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

    def __post_init__(self):
        points, shape = np.asarray(self.points, dtype=np.float64), tuple(np.shape(self.heights))
        if points.ndim != 2 or points.shape[1] != 2 or shape != points.shape[:1]:
            raise ValueError(f"expected points (points, 2) and heights (points,), got {points.shape} and {shape}")
        object.__setattr__(self, "points", points)
        object.__setattr__(self, "triangles", np.asarray(self.triangles, dtype=np.int64))
        object.__setattr__(self, "n_water", number(self.n_water))
        require_index(self.n_water)
        if namespace(self.heights).name == "numpy":
            object.__setattr__(self, "heights", np.asarray(self.heights, dtype=np.float64))
        # What torch.compile traces is checked when it runs.
        if not compiling():
            object.__setattr__(self, "triangles", self.mesh.triangles)
        if not transformed() and not self.wet_triangles.any():
            raise ValueError("expected at least one triangle with three finite heights, got none")

    @property
    def numbers(self) -> tuple:
        """Parameters of the surface."""
        return self.points, self.heights, self.triangles, self.n_water

    @classmethod
    def from_numbers(cls, points, heights, triangles, n_water) -> HeightFieldWater:
        """The surface with these `numbers`."""
        return cls(points, heights, triangles, n_water=n_water)

    @cached_property
    def mesh(self) -> Triangulation:
        """The triangles and their neighbours; the same object for surfaces over the same points."""
        return _triangulated(self.points.shape, self.points.tobytes(), self.triangles.shape, self.triangles.tobytes())

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
            if not compiling() and not (np.all(steps > 0.0) or np.all(steps < 0.0)):
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
        """Water over scattered points (points, 2) [m], local, with heights (points,) [m], by Delaunay's triangles.

        Raises
        ------
        ValueError
            If the points are fewer than three, on one line, or not finite.
        """
        from scipy.spatial import Delaunay, QhullError

        points = np.asarray(points, dtype=np.float64)
        try:
            triangles = Delaunay(points).simplices
        except (QhullError, ValueError) as error:
            raise ValueError(f"expected three points or more, finite and not on one line, got {len(points)}") from error
        return cls(points, heights, triangles, n_water=n_water)

    @cached_property
    def plain_heights(self) -> np.ndarray:
        """The heights in numpy, without gradients."""
        return as_numpy(self.heights)

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
        slope_x, slope_y = _slopes(*(v[self.triangles] for v in (*self.points.T, filled)))
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
        corners, points, heights = self.triangles, self.points, self.heights
        if namespace(like).name == "torch":
            corners, points = as_like(corners, triangle), as_like(points, like)
            heights = as_like(heights, like).to(like.dtype)
        else:
            heights = self.plain_heights
        corners = corners[triangle]
        x, y, z = points[:, 0][corners], points[:, 1][corners], heights[corners]
        return (x[..., 0], y[..., 0], z[..., 0]), _slopes(x, y, z)

    def or_any(self, triangle):
        """`triangle` where there is one, elsewhere any wet triangle, whose numbers keep values and gradients finite."""
        return np.where(triangle >= 0, triangle, self.wet_triangles.argmax())

    def _plane_at(self, x, y):
        """The plane at each place, as `planes`, and whether there is water."""
        _needs_numpy_or_torch(x)
        xp, (x, y) = namespace(x, y), _of_one_shape(x, y)
        triangle, wet = read(_triangulation.triangle_at, self, (xp.double(x), xp.double(y)))
        return *self.planes(xp.integer(triangle), x), wet > 0.0

    def height(self, x, y):
        """Height z of the surface [m] at local x, y [m]; NaN where there is no water."""
        (cx, cy, cz), (slope_x, slope_y), wet = self._plane_at(x, y)
        z = cz + slope_x * (x - cx) + slope_y * (y - cy)
        return namespace(x).where(wet, z, math.nan)

    def normal(self, x, y) -> tuple[Any, Any, Any]:
        """Unit normal of the triangle at x, y, pointing up into the air; NaN where there is no water."""
        xp, (_, (slope_x, slope_y), wet) = namespace(x), self._plane_at(x, y)
        up = 1.0 / xp.sqrt(1.0 + slope_x * slope_x + slope_y * slope_y)
        return tuple(xp.where(wet, c, math.nan) for c in (-slope_x * up, -slope_y * up, up))

    def intersect(self, origin, direction):
        """Distance [m] to the first meeting with the surface along unit rays from above; NaN where there is none.

        Exact: a walk from triangle to triangle under the ray, each of them a plane.
        """
        _needs_numpy_or_torch(origin[0])
        like = origin[0] + direction[0]
        origin, direction = fermat.together(origin, direction)
        xp = namespace(*origin)
        triangle, meets = read(_triangulation.triangle_met, self, origin + direction)
        corner, slopes = self.planes(xp.integer(triangle), origin[0])
        over, rate = _triangulation.clearance(corner, slopes, origin, direction)
        t = -over / xp.where(meets > 0.0, rate, -1.0)
        return xp.like(xp.where(meets > 0.0, xp.maximum(t, 0.0), math.nan), like)

    def crossing(self, camera, point, steps: int):
        """See `WaterSurface.crossing`: the shortest of all paths through plane triangles (`_facet_paths`)."""
        _needs_numpy_or_torch(point[0])
        return _facet_paths.crossing(self, camera, point)


@lru_cache(maxsize=_KEPT)
def _triangulated(shape, points: bytes, faces, triangles: bytes) -> Triangulation:
    """The triangulation of arrays of float64 and int64, known by their bytes."""
    return Triangulation(np.frombuffer(points).reshape(shape), np.frombuffer(triangles, dtype=np.int64).reshape(faces))


def _slopes(x, y, z):
    """Slopes along x and y of planes through corners at x, y, z (..., 3)."""
    (ax, bx), (ay, by), (az, bz) = ((v[..., 1] - v[..., 0], v[..., 2] - v[..., 0]) for v in (x, y, z))
    area = ax * by - ay * bx
    return (az * by - bz * ay) / area, (bz * ax - az * bx) / area


def _of_one_shape(x, y):
    """Arrays of one shape, and those of numpy at least one."""
    return alike(x + 0.0 * y, y + 0.0 * x)


def _needs_numpy_or_torch(array):
    if namespace(array).name == "drjit":
        raise TypeError(
            "HeightFieldWater runs on numpy and torch, got Dr.Jit arrays; convert them, or take FlatWater, WavyWater "
            "or SphericalWater, which run on Dr.Jit"
        )
