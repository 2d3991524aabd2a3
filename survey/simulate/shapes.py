"""Solid things, a bed over a grid, convex bodies and bodies of any triangles, and where straight rays meet them.

Everything is flat-faced, so that the mesh that is written as the truth *is* the surface that is photographed,
to the last bit, and every intersection is the solution of a linear equation. Local frame, metres, float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from igl.embree import EmbreeIntersector
from scipy.ndimage import maximum_filter
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

# Sizes of blocks of cells, which a ray skips while it stays above their highest vertex.
_BLOCKS = (16, 4)
# A coordinate this close to a line of the triangulation counts as on it [cells]: 2e-11 m, more than rounding.
_ON_LINE = 1e-9
# Coarse steps stop this close above the bound [m].
_TOUCH_M = 1e-6
# Embree works in float32: a ray that ends this much before a triangle still finds it [of the distance].
_SLACK = 1e-5


class BedGrid:
    """A height field of triangles: square cells, each cut from its upper left to its lower right corner.

    Heights (ny, nx) [m] of the vertices go north by rows and east by columns, `cell` [m] apart, from west, south [m].
    """

    def __init__(self, heights: np.ndarray, west: float, south: float, cell: float):
        self.heights = np.ascontiguousarray(heights, dtype=np.float64)
        self.west, self.south, self.cell = west, south, cell
        self.top = float(self.heights.max())
        self._highest = [(size, _highest_around(self.heights, size)) for size in _BLOCKS]

    def height(self, x, y) -> np.ndarray:
        """Height (...) [m] of the bed at x, y (...) [m]; beyond the grid that of its border."""
        return self._height_in_cells((np.asarray(x) - self.west) / self.cell, (np.asarray(y) - self.south) / self.cell)

    def vertices(self) -> np.ndarray:
        """Vertices (ny, nx, 3) [m], local."""
        ny, nx = self.heights.shape
        x, y = np.meshgrid(self.west + self.cell * np.arange(nx), self.south + self.cell * np.arange(ny))
        return np.stack([x, y, self.heights], axis=-1)

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (V, 3) [m], triangles (F, 3) with normals up, and for each the face (F,) that `hit` names."""
        ny, nx = self.heights.shape
        sw = (np.arange(ny - 1)[:, None] * nx + np.arange(nx - 1)).ravel()
        se, nw, ne = sw + 1, sw + nx, sw + nx + 1
        faces = np.concatenate([np.stack([sw, se, nw], -1), np.stack([ne, nw, se], -1)])
        return self.vertices().reshape(-1, 3), faces, np.zeros(len(faces), dtype=np.int64)

    def hit(self, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) [m] to the bed on rays (N, 3), and the face (N,), which is 0.

        Rays fall (``z < 0``), start above the bed and end at `t_end` (N,) [m]; the distance is infinite where the bed
        does not come before. Between crossings of the lines x = i, y = j and x + y = k of the triangulation the bed is
        linear along the ray: the sign of ray minus bed at these crossings brackets the root, which is then exact.
        """
        u, v = (origin[:, 0] - self.west) / self.cell, (origin[:, 1] - self.south) / self.cell
        du, dv = direction[:, 0] / self.cell, direction[:, 1] / self.cell
        with np.errstate(divide="ignore"):
            ray = _Rays(u, v, origin[:, 2], du, dv, direction[:, 2], 1.0 / np.hypot(du, dv))
        t = np.maximum((self.top - ray.z) / ray.dz, 0.0)
        self._fall(ray, t, t_end)
        found = np.full(len(t), np.inf)
        live = np.flatnonzero(t < t_end)
        ray, t = ray.take(live), t[live]
        gap = np.maximum(self._gap(ray, t), 0.0)
        while live.size:
            step = ray.to_next_line(t)
            gap_next = self._gap(ray, t + step)
            below = gap_next <= 0.0
            found[live[below]] = (t + step * gap / np.where(below, gap - gap_next, 1.0))[below]
            on = ~below & (t + step < t_end[live])
            live, ray, t, gap = live[on], ray.take(on), (t + step)[on], gap_next[on]
        return np.where(found <= t_end, found, np.inf), np.zeros(len(found), dtype=np.int64)

    def _fall(self, ray: _Rays, t: np.ndarray, t_end: np.ndarray) -> None:
        """Advance `t`, in place, through air above the highest vertices nearby."""
        for size, highest in self._highest:
            live = np.flatnonzero(t < t_end)
            rays, at = ray.take(live), t[live]
            while live.size:
                u, v, z = rays.at(at)
                block = [
                    np.clip((c / size).astype(np.int64), 0, count - 1)
                    for c, count in zip((v, u), highest.shape, strict=True)
                ]
                gap = z - highest[tuple(block)]
                at = at + np.maximum(np.minimum(-gap / rays.dz, size * rays.reach), 0.0)
                t[live] = at
                on = (gap > _TOUCH_M) & (at < t_end[live])
                live, rays, at = live[on], rays.take(on), at[on]

    def _gap(self, ray: _Rays, t: np.ndarray) -> np.ndarray:
        u, v, z = ray.at(t)
        return z - self._height_in_cells(u, v)

    def _height_in_cells(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        ny, nx = self.heights.shape
        u, v = np.clip(u, 0.0, nx - 1.0), np.clip(v, 0.0, ny - 1.0)
        i, j = np.minimum(u.astype(np.int64), nx - 2), np.minimum(v.astype(np.int64), ny - 2)
        u, v = u - i, v - j
        flat, sw = self.heights.ravel(), j * nx + i
        se, nw = flat[sw + 1], flat[sw + nx]
        lower = u + v <= 1.0
        # The corner of the triangle, and from there along its two legs.
        corner = flat[np.where(lower, sw, sw + nx + 1)]
        along_u, along_v = np.where(lower, u, 1.0 - u), np.where(lower, v, 1.0 - v)
        return corner + along_u * (np.where(lower, se, nw) - corner) + along_v * (np.where(lower, nw, se) - corner)


class _Rays(NamedTuple):
    """Rays with x and y counted in cells of a grid: where they start, and their change per metre."""

    u: np.ndarray
    v: np.ndarray
    z: np.ndarray
    du: np.ndarray
    dv: np.ndarray
    dz: np.ndarray
    reach: np.ndarray  # metres of ray per cell of horizontal way

    def take(self, which: np.ndarray) -> _Rays:
        return _Rays(*(part[which] for part in self))

    def at(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        return self.u + t * self.du, self.v + t * self.dv, self.z + t * self.dz

    def to_next_line(self, t: np.ndarray) -> np.ndarray:
        """Distance [m] from `t` to the next line of the triangulation."""
        u, v, _ = self.at(t)
        step = np.full(len(t), np.inf)
        for c, rate in ((u, self.du), (v, self.dv), (u + v, self.du + self.dv)):
            to_line = c - np.floor(c)
            to_line = np.where(rate > 0.0, 1.0 - to_line, to_line)
            to_line = np.where(to_line < _ON_LINE, 1.0, to_line)
            with np.errstate(divide="ignore"):
                step = np.minimum(step, to_line / np.abs(rate))
        # A vertical ray crosses no line: any length will do, as the bed is linear along it.
        return np.where(np.isfinite(step), step, 1.0)


def _highest_around(heights: np.ndarray, size: int) -> np.ndarray:
    """Highest vertex in each block of cells and its eight neighbours: one block of way stays inside."""
    rows, columns = (np.minimum(np.arange(size // 2, n - 1 + size // 2, size), n - 1) for n in heights.shape)
    return maximum_filter(heights, size=3 * size + 1, mode="nearest")[np.ix_(rows, columns)]


@dataclass(frozen=True)
class Solid:
    """A convex body."""

    vertices: np.ndarray  # (V, 3) [m], local
    faces: np.ndarray  # (F, 3): Triangles, normals outward
    plane_of_face: np.ndarray  # (F,)
    # normals, offsets (P, 3), (P,) [m]: planes of the faces: inside is where ``normal . p <= offset`` for all of them.
    normals: np.ndarray
    offsets: np.ndarray
    # centre, radius (3,) [m], [m]: a ball around it
    centre: np.ndarray
    radius: float

    @classmethod
    def around(cls, points: np.ndarray) -> Solid:
        """The convex hull of points (N, 3) [m]."""
        hull = ConvexHull(points)
        vertices = points[hull.vertices]
        place = np.full(len(points), -1)
        place[hull.vertices] = np.arange(len(vertices))
        faces, planes = place[hull.simplices], hull.equations
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), planes[:, :3]) < 0.0
        faces[inward] = faces[inward][:, ::-1]
        # Coplanar triangles share a plane up to rounding: one of each is enough.
        _, first, same = np.unique(np.round(planes, 9), axis=0, return_index=True, return_inverse=True)
        order = np.argsort(first)
        planes, plane_of_face = planes[first[order]], np.argsort(order)[same.ravel()]
        centre = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
        radius = float(np.linalg.norm(vertices - centre, axis=1).max())
        return cls(vertices, faces, plane_of_face, planes[:, :3], -planes[:, 3], centre, radius)

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (V, 3) [m], triangles (F, 3) with normals outward, and for each the plane (F,) that `hit` names."""
        return self.vertices, self.faces, self.plane_of_face

    def hit(self, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) [m] at which rays (N, 3) enter up to `t_end`, infinite for none, and the plane (N,) there."""
        rate = direction @ self.normals.T
        with np.errstate(divide="ignore", invalid="ignore"):
            at = (self.offsets - origin @ self.normals.T) / rate
        entering = np.where(rate < 0.0, at, -np.inf)
        leaving = np.where(rate > 0.0, at, np.inf).min(axis=1)
        outside = ((rate == 0.0) & (at < 0.0)).any(axis=1)
        t = entering.max(axis=1)
        return np.where((t <= leaving) & (t > 0.0) & (t <= t_end) & ~outside, t, np.inf), entering.argmax(axis=1)


def near_solids(solids: Sequence, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray) -> np.ndarray:
    """Whether rays (N, 3) pass through the ball around each body before `t_end` (N,): (N, number of solids)."""
    near = np.zeros((len(origin), len(solids)), dtype=bool)
    # Rays of neighbouring pixels are close to each other: most bodies lie beside the box around all of them.
    with np.errstate(invalid="ignore"):
        ends = origin + t_end[:, None] * direction
    low, high = np.minimum(origin, ends).min(axis=0), np.maximum(origin, ends).max(axis=0)
    from_origin2 = np.einsum("ij,ij->i", origin, origin)
    start = np.einsum("ij,ij->i", origin, direction)
    for index, solid in enumerate(solids):
        centre, radius = np.asarray(solid.centre), solid.radius
        # A ray without an end makes a bound NaN, which no comparison rules out.
        if ((centre + radius < low) | (centre - radius > high)).any():
            continue
        along = direction @ centre - start
        distance2 = from_origin2 - 2.0 * (origin @ centre) + centre @ centre
        near[:, index] = (distance2 - along**2 < radius**2) & (along > -radius) & (along < t_end + radius)
    return near


def rotation(yaw: float, pitch: float = 0.0, roll: float = 0.0) -> np.ndarray:
    """Rotation (3, 3) by roll about x, then pitch about y, then yaw about z [rad]."""
    return Rotation.from_euler("ZYX", (yaw, pitch, roll)).as_matrix()


class TriangleMesh:
    """Triangles in space, open or closed: vertices (V, 3) [m], local, and faces (F, 3).

    Faces are counter-clockwise as seen from the side that their unit normals (F, 3) point to, which are zero where a
    triangle has no area. A ball of `centre` (3,) and `radius` [m] is around it.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray):
        self.vertices = np.ascontiguousarray(vertices, dtype=np.float64)
        self.faces = np.ascontiguousarray(faces, dtype=np.int64)
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        normals = np.cross(b - a, c - a)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        self.normals = normals / np.where(length > 0.0, length, 1.0)
        self._offsets = np.einsum("ij,ij->i", self.normals, a)
        low, high = self.vertices.min(axis=0), self.vertices.max(axis=0)
        self.centre, self.top = 0.5 * (low + high), float(high[2])
        self.radius = float(np.linalg.norm(self.vertices - self.centre, axis=1).max())

    @cached_property
    def _tree(self) -> EmbreeIntersector:
        tree = EmbreeIntersector()
        # Relative to the middle of the body, where float32 is finest.
        vertices = np.asfortranarray(self.vertices - self.centre, dtype=np.float32)
        tree.init(vertices, np.asfortranarray(self.faces, dtype=np.int32))
        return tree

    def mesh(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (V, 3) [m], triangles (F, 3), and for each the face (F,) that `hit` names: itself."""
        return self.vertices, self.faces, np.arange(len(self.faces))

    def hit(self, origin: np.ndarray, direction: np.ndarray, t_end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distance (N,) [m] to the first triangle on rays (N, 3), infinite for a miss, and the triangle (N,)."""
        # Rays start near the body, so that float32 covers only a short distance.
        start = np.einsum("ij,ij->i", self.centre - origin, direction) - self.radius
        start = np.maximum(start, 0.0)
        near = (origin + start[:, None] * direction - self.centre).astype(np.float32)
        direction32, reach = direction.astype(np.float32), ((t_end - start) * (1.0 + _SLACK)).astype(np.float32)
        face = np.full(len(origin), -1)
        first = self._tree.intersectRay_first
        for ray in np.flatnonzero(reach > 0.0):
            found = first(near[ray], direction32[ray], 0.0, float(reach[ray]))
            face[ray] = found[0]
        return self._distance(origin, direction, face, t_end), face

    def _distance(self, origin, direction, face, t_end) -> np.ndarray:
        """Distance (N,) to the plane of a triangle, in float64."""
        normal = self.normals[face]
        rate = np.einsum("ij,ij->i", direction, normal)
        is_hit = (face >= 0) & (rate != 0.0)
        gap = self._offsets[face] - np.einsum("ij,ij->i", origin, normal)
        t = np.where(is_hit, gap / np.where(is_hit, rate, 1.0), np.inf)
        return np.where((t > 0.0) & (t <= t_end), t, np.inf)

    def height(self, x, y) -> np.ndarray:
        """Height (...) [m] of the topmost triangle at x, y (...) [m]; NaN beside the mesh."""
        return height_of(self, x, y, self.top + 1.0)


def height_of(shape: Solid | TriangleMesh, x, y, above: float) -> np.ndarray:
    """Height (...) [m] of the top of a body at x, y (...) [m], by rays down from a height above it; NaN beside it."""
    x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
    origin = np.stack([x.ravel(), y.ravel(), np.full(x.size, above)], axis=-1)
    t, _ = shape.hit(origin, np.tile([0.0, 0.0, -1.0], (x.size, 1)), np.full(x.size, np.inf))
    return np.where(np.isfinite(t), above - t, np.nan).reshape(x.shape)
