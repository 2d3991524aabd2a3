"""A body of any triangles, and where straight rays meet it: Embree finds the triangle, float64 arithmetic the point."""

from __future__ import annotations

from functools import cached_property

import numpy as np
from igl.embree import EmbreeIntersector

# Embree works in float32: a ray that ends this much before a triangle still finds it [of the distance].
_SLACK = 1e-5


class TriangleMesh:
    """Triangles in space, open or closed.

    Parameters
    ----------
    vertices : (V, 3) [m], local
    faces : (F, 3)
        Counter-clockwise as seen from the side that normals point to.

    Attributes
    ----------
    normals : (F, 3)
        Unit; zero where a triangle has no area.
    centre, radius : (3,) [m], [m]
        A ball around it.
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
        # Near the middle of the body float32 steps least.
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
        ahead, reach = direction.astype(np.float32), ((t_end - start) * (1.0 + _SLACK)).astype(np.float32)
        face = np.full(len(origin), -1)
        first = self._tree.intersectRay_first
        for ray in np.flatnonzero(reach > 0.0):
            found = first(near[ray], ahead[ray], 0.0, float(reach[ray]))
            face[ray] = found[0]
        return self._distance(origin, direction, face, t_end), face

    def _distance(self, origin, direction, face, t_end) -> np.ndarray:
        """Distance (N,) to the plane of a triangle, in float64."""
        normal = self.normals[face]
        rate = np.einsum("ij,ij->i", direction, normal)
        met = (face >= 0) & (rate != 0.0)
        gap = self._offsets[face] - np.einsum("ij,ij->i", origin, normal)
        t = np.where(met, gap / np.where(met, rate, 1.0), np.inf)
        return np.where((t > 0.0) & (t <= t_end), t, np.inf)

    def height(self, x, y) -> np.ndarray:
        """Height (...) [m] of the topmost triangle at x, y (...) [m]; NaN beside the mesh."""
        x, y = np.broadcast_arrays(np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64))
        above = self.top + 1.0
        origin = np.stack([x.ravel(), y.ravel(), np.full(x.size, above)], axis=-1)
        t, _ = self.hit(origin, np.tile([0.0, 0.0, -1.0], (x.size, 1)), np.full(x.size, np.inf))
        return np.where(np.isfinite(t), above - t, np.nan).reshape(x.shape)
