"""Triangles as geometry: areas, normals, shared vertices, and the nearest point on a triangle, in float64.

Symbols: ``vertices`` (V, 3) [m, any one Cartesian frame], ``faces`` (F, 3) vertex numbers, corners a, b, c in
the winding of the face; normals are right-handed about that winding.
"""

from __future__ import annotations

import numpy as np

# Twice the area over the square of the longest edge, below which a triangle is a line or a point: rounding
# (1e-16 relative) would turn its normal by 1e-4 and more.
_THINNEST = 1e-12
# Corners of the feature of a triangle on which the nearest point lies, as columns of its face: inside, the
# edges ab, bc, ca, the vertices a, b, c. A vertex is listed twice, inside is -1.
FEATURE_CORNERS = np.array([[-1, -1], [0, 1], [1, 2], [2, 0], [0, 0], [1, 1], [2, 2]])
INSIDE = 0


def weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same triangles with vertices of exactly equal coordinates merged.

    Triangles that each have their own vertices have no known neighbours otherwise. Call it on
    coordinates as they were read: equal ones need not stay equal to the last bit in another frame.

    Returns
    -------
    vertices (W, 3), faces (F, 3)
        W is at most V; vertices keep their order of first appearance, faces keep theirs.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    first, number = distinct(vertices)
    return vertices[first], number[np.asarray(faces, dtype=np.int64)]


def distinct(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First occurrences of the distinct points among (N, 3), and the index of the one that each point equals.

    Returns
    -------
    first (W,), number (N,) : int64
        ``points[first]`` holds every distinct point once, in order of appearance, and
        ``points[first][number]`` is ``points``.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    order = np.lexsort(points.T)
    is_new = np.ones(len(points), dtype=bool)
    is_new[1:] = (points[order[1:]] != points[order[:-1]]).any(axis=1)
    group = np.cumsum(is_new) - 1
    # lexsort is stable, so the first of each group is its first appearance.
    first = order[is_new]
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    number = np.empty(len(points), dtype=np.int64)
    number[order] = rank[group]
    return np.sort(first), number


def num_inconsistent_edges(faces: np.ndarray) -> int:
    """Number of edges that two triangles (F, 3) traverse in the same direction: those with inconsistent winding.

    Vertices have to be shared, see `weld`. Zero for a consistently oriented surface, whatever its shape.
    """
    faces = np.asarray(faces, dtype=np.int64)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = edges[edges[:, 0] != edges[:, 1]]
    _, count = np.unique(edges[:, 0] * (faces.max(initial=0) + 1) + edges[:, 1], return_counts=True)
    return int((count > 1).sum())


def area_vectors(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Normals (F, 3) whose lengths are the areas of the triangles [m²]."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    return 0.5 * np.cross(b - a, c - a)


def has_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether each triangle (F,) has a surface, rather than being a line or a point to rounding."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    longest = np.max([np.square(e).sum(axis=1) for e in (b - a, c - b, a - c)], axis=0)
    return 2.0 * np.linalg.norm(area_vectors(vertices, faces), axis=1) > _THINNEST * longest


def closest_on_triangles(points: np.ndarray, corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The point of each triangle that is nearest to the point of the same row.

    Parameters
    ----------
    points : (N, 3) [m]
    corners : (N, 3, 3) [m]
        Corners a, b, c of triangles that have an area.

    Returns
    -------
    nearest : (N, 3) [m]
    feature : (N,) int
        Where on the triangle it lies, a row of `FEATURE_CORNERS`: 0 inside, 1 to 3 an edge, 4 to 6 a vertex.

    Notes
    -----
    The Voronoi regions of the triangle in its plane, after C. Ericson, Real-Time Collision Detection (2005),
    section 5.1.5.
    """
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    ab, ac = b - a, c - a
    d1, d2 = _dot(ab, points - a), _dot(ac, points - a)
    d3, d4 = _dot(ab, points - b), _dot(ac, points - b)
    d5, d6 = _dot(ab, points - c), _dot(ac, points - c)
    # Barycentric coordinates of the foot on the plane, times a common positive factor.
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    feature = np.select(
        [
            (d1 <= 0.0) & (d2 <= 0.0),
            (d3 >= 0.0) & (d4 <= d3),
            (d6 >= 0.0) & (d5 <= d6),
            (vc <= 0.0) & (d1 >= 0.0) & (d3 <= 0.0),
            (va <= 0.0) & (d4 - d3 >= 0.0) & (d5 - d6 >= 0.0),
            (vb <= 0.0) & (d2 >= 0.0) & (d6 <= 0.0),
        ],
        [4, 5, 6, 1, 2, 3],
        default=INSIDE,
    )
    ones, zeros = np.ones_like(d1), np.zeros_like(d1)
    along_ab = _share(d1, d1 - d3)
    along_bc = _share(d4 - d3, (d4 - d3) + (d5 - d6))
    along_ac = _share(d2, d2 - d6)
    total = va + vb + vc
    v = np.choose(feature, [_share(vb, total), along_ab, 1.0 - along_bc, zeros, zeros, ones, zeros])
    w = np.choose(feature, [_share(vc, total), zeros, along_bc, along_ac, zeros, zeros, ones])
    return a + v[:, None] * ab + w[:, None] * ac, feature


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)


def _share(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """part / whole, or 0 where the whole is 0; such values belong to a region that is not chosen."""
    return np.divide(part, whole, out=np.zeros_like(part), where=whole != 0.0)
