"""Signed distance from a cloud to a mesh (C2M), exact to rounding in float64.

**Sign: positive above the reference, negative below it.** A bed that is too shallow has a positive mean, a bed that is
too deep a negative one. "Above" is the side to which the upward normal of the triangle points (``sign="up"``, z up), or
the side from which its corners run counter-clockwise (``sign="winding"``, as in CloudCompare). The sign is the same in
`evaluation.vertical_difference` and `evaluation.m3c2_distances`.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import igl
import numpy as np

from evaluation.triangles import FEATURE_CORNERS, INSIDE, area_vectors, closest_on_triangles, has_area, weld

Sign = Literal["up", "winding"]

# Neither side of a steeper triangle can be called the upper one: its winding decides.
_STEEP_NZ = 0.05
# Points at a time for each thread: about 75 MB of intermediate values. The tree is searched on all cores at once;
# threads keep them busy with the next ones.
_CHUNK = 100_000
_WORKERS = min(os.cpu_count() or 1, 4)
# Pairs of point and triangle at a time, where several triangles are equally near.
_PAIR_CHUNK = 1_000_000
# |cos| that differ by less are equal; rounding of unit vectors is 1e-16, of feet on triangles far away 1e-11.
_EQUAL_COS = 1e-9


@dataclass(frozen=True)
class MeshDistances:
    """Distances of points to a mesh."""

    signed: np.ndarray  # (N,) [m]: NaN for points that are not finite
    nearest: np.ndarray  # (N, 3) [m]: the nearest point of the mesh
    # (N,) [deg]: slope of the nearest triangle, 0 level to 90 upright, whichever side is up; NaN for points that are
    # not finite
    slope_deg: np.ndarray
    num_degenerate: int  # Triangles without area, which were left out


def distance_to_mesh(
    points: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    sign: Sign = "up",
    advance: Callable[[int], object] | None = None,
) -> MeshDistances:
    """Signed distance of points to the nearest point of a mesh.

    Parameters
    ----------
    points : (N, 3) [m]
    vertices : (V, 3) [m], same Cartesian frame, z up
    faces : (F, 3) int
    sign : {"up", "winding"}
        ``"up"``: positive above. Triangles whose normal points down (n_z below -0.05) are reversed first,
        the winding is kept where |n_z| is at most 0.05. ``"winding"``: positive on the side from which the
        corners run counter-clockwise, as CloudCompare signs.
    advance : callable, optional
        Called with the number of points that were finished since the last call.

    Returns
    -------
    MeshDistances
        Points beyond the rim of an open mesh have the distance to the rim.

    Notes
    -----
    Where the nearest point lies on an edge or a vertex, several triangles are equally near and may disagree on the
    sign. As in the robust mode of CloudCompare 2.13.1, the triangle decides whose plane is most nearly
    perpendicular to the direction to the point. That is right at every edge; at the tip of a needle or blade it
    can be wrong, as in CloudCompare. On the surface, and where triangles of opposite sign are equally
    perpendicular, the sign is positive.
    """
    if sign not in ("up", "winding"):
        raise ValueError(f'sign is {sign!r}, expected "up" or "winding"')
    points = np.asarray(points, dtype=np.float64)
    vertices, faces = weld(vertices, faces)
    sound = has_area(vertices, faces)
    if not sound.any():
        raise ValueError(f"none of the {len(faces)} triangles has an area, expected a surface")
    # Relative to a point nearby: a northing of 5e6 m would cost nine of the sixteen digits of float64.
    origin = 0.5 * (vertices.min(axis=0) + vertices.max(axis=0))
    surface = _Surface(vertices - origin, faces[sound], sign)
    signed = np.full(len(points), np.nan)
    nearest = np.full(points.shape, np.nan)
    slope_deg = np.full(len(points), np.nan)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    order = finite[_morton_order(points[finite])]
    parts = [order[start : start + _CHUNK] for start in range(0, len(order), _CHUNK)]
    with ThreadPoolExecutor(_WORKERS) as pool:
        for rows, found in zip(
            parts, pool.map(lambda rows: surface.measure(points[rows] - origin), parts), strict=True
        ):
            signed[rows], nearest[rows], slope_deg[rows] = found
            if advance is not None:
                advance(len(rows))
    return MeshDistances(signed, nearest + origin, slope_deg, int((~sound).sum()))


class _Surface:
    """A mesh prepared for queries: tree of boxes, normals to the positive side, triangles around each vertex."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, sign: Sign):
        self._vertices = np.ascontiguousarray(vertices)
        self._faces = np.ascontiguousarray(faces)
        normals = area_vectors(vertices, faces)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        if sign == "up":
            normals[normals[:, 2] < -_STEEP_NZ] *= -1.0
        self._normals = normals
        self._slope_deg = np.degrees(np.arctan2(np.hypot(normals[:, 0], normals[:, 1]), np.abs(normals[:, 2])))
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        # Triangles around vertex v: star_faces[star_start[v] : star_start[v + 1]].
        corners = self._faces.ravel()
        self._star_faces = np.argsort(corners, kind="stable") // 3
        self._star_start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=len(vertices)))])

    def measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Signed distances (N,), nearest points (N, 3) and the slopes there (N,) [deg]."""
        # igl squeezes a single row.
        hit = np.reshape(self._tree.squared_distance(self._vertices, self._faces, points)[1], len(points))
        nearest, feature = closest_on_triangles(points, self._vertices[self._faces[hit]])
        direction = points - nearest
        distance = np.linalg.norm(direction, axis=1)
        direction /= np.where(distance > 0.0, distance, 1.0)[:, None]
        positive = np.einsum("ij,ij->i", direction, self._normals[hit]) >= 0.0
        tied = np.flatnonzero((feature != INSIDE) & (distance > 0.0))
        for rows, counts in self._blocks(tied, hit, feature):
            positive[rows] = self._is_above(direction[rows], hit[rows], feature[rows], counts)
        return np.where(positive, distance, -distance), nearest, self._slope_deg[hit]

    def _blocks(self, tied: np.ndarray, hit: np.ndarray, feature: np.ndarray):
        """The tied points in blocks of bounded work, each with the sizes of their stars (triangles around a vertex)."""
        start = self._faces[hit[tied], FEATURE_CORNERS[feature[tied], 0]]
        counts = self._star_start[start + 1] - self._star_start[start]
        block = np.cumsum(counts) // _PAIR_CHUNK
        cuts = np.flatnonzero(np.diff(block)) + 1
        return zip(np.split(tied, cuts), np.split(counts, cuts), strict=True) if len(tied) else ()

    def _is_above(self, direction: np.ndarray, hit: np.ndarray, feature: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Whether points (N,) whose nearest point is on an edge or vertex lie above the surface.

        ``direction`` are unit vectors from there to the points, ``counts`` the sizes of the stars of the first
        vertex.
        """
        corners = self._faces[hit[:, None], FEATURE_CORNERS[feature]]
        starts = np.cumsum(counts) - counts
        point = np.repeat(np.arange(len(hit)), counts)
        within = np.arange(counts.sum()) - starts[point]
        face = self._star_faces[self._star_start[corners[point, 0]] + within]
        cos = np.einsum("ij,ij->i", direction[point], self._normals[face])
        # Around an edge only the triangles that have its other vertex too.
        shares = (self._faces[face] == corners[point, 1, None]).any(axis=1)
        orthogonality = np.where(shares, np.abs(cos), -1.0)
        most = np.maximum.reduceat(orthogonality, starts)
        chosen = orthogonality >= most[point] - _EQUAL_COS
        return np.logical_or.reduceat(chosen & (cos >= 0.0), starts)


def _morton_order(points: np.ndarray) -> np.ndarray:
    """Order (N,) of points along a Morton curve in plan.

    The tree then finds its boxes in the cache: six times faster than in random order.
    """
    if len(points) == 0:
        return np.empty(0, dtype=np.int64)
    plan = points[:, :2]
    low, high = plan.min(axis=0), plan.max(axis=0)
    step = np.where(high > low, (high - low) / 65535.0, 1.0)
    column, row = ((plan - low) / step).astype(np.uint32).T
    code = _spread_bits(column) | (_spread_bits(row) << np.uint32(1))
    # numpy sorts 16-bit integers by radix sort, ten times as fast as 32-bit ones by comparison.
    return np.lexsort(((code & np.uint32(0xFFFF)).astype(np.uint16), (code >> np.uint32(16)).astype(np.uint16)))


def _spread_bits(values: np.ndarray) -> np.ndarray:
    """The lower 16 bits of values (N,) uint32 at the even places of 32."""
    for shift, mask in ((8, 0x00FF00FF), (4, 0x0F0F0F0F), (2, 0x33333333), (1, 0x55555555)):
        values = (values | (values << np.uint32(shift))) & np.uint32(mask)
    return values
