"""Signed distance from a cloud to a mesh (C2M), exact to rounding in float64; how much of a reference a cloud reaches.

**Sign: positive above the reference, negative below it.** A bed that is too shallow has a positive mean, a bed that is
too deep a negative one. "Above" is the side to which the upward normal of the triangle points (``sign="up"``, z up), or
the side from which its corners run counter-clockwise (``sign="winding"``, as in CloudCompare). The sign is the same in
`evaluation.vertical_difference` and `evaluation.m3c2_distances`.
"""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Literal

import igl
import numpy as np
from scipy.spatial import cKDTree

# Twice the area over the square of the longest edge, below which a triangle is a line or a point: rounding
# (1e-16 relative) would turn its normal by 1e-4 and more.
_THINNEST = 1e-12
NUM_SAMPLES = 1_000_000
SEED = 20_060_617  # any number, but always the same: two comparisons of one cloud give one result
# Relative margin of the search, so that its rounding drops nothing that the strict test below would keep.
_SEARCH_MARGIN = 1e-9


def weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same triangles with vertices of exactly equal coordinates merged: vertices (W, 3), faces (F, 3).

    Triangles that each have their own vertices have no known neighbours otherwise. Call it on coordinates as they were
    read: equal ones need not stay equal to the last bit in another frame. Orders of vertices and faces stay.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    first, number = distinct(vertices)
    return vertices[first], number[np.asarray(faces, dtype=np.int64)]


def distinct(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """First occurrences (W,) of the distinct points among (N, 3), in order, and which of them each one (N,) equals."""
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


def slope_deg(normals: np.ndarray) -> np.ndarray:
    """Slopes (F,) [deg] of triangles with normals (F, 3), 0 level to 90 upright, whichever side is up."""
    return np.degrees(np.arctan2(np.hypot(normals[:, 0], normals[:, 1]), np.abs(normals[:, 2])))


def has_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether each triangle (F,) has a surface, rather than being a line or a point to rounding."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    longest = np.max([np.square(e).sum(axis=1) for e in (b - a, c - b, a - c)], axis=0)
    return 2.0 * np.linalg.norm(area_vectors(vertices, faces), axis=1) > _THINNEST * longest


Sign = Literal["up", "winding"]

# Neither side of a steeper triangle can be called the upper one: its winding decides.
_STEEP_NZ = 0.05
# Points at a time for each thread: about 75 MB of intermediate values. The tree is searched on all cores at once;
# threads keep them busy with the next ones.
_CHUNK = 100_000
_WORKERS = min(os.cpu_count() or 1, 4)
# Pairs of point and triangle at a time, where several triangles are equally near.
_PAIR_CHUNK = 1_000_000
# Nearest points whose barycentric coordinates say that they are nearer to an edge than this share count as on it.
_ON_EDGE = 1e-6
# |cos| that differ by less are equal; rounding of unit vectors is 1e-16, of feet on triangles far away 1e-11.
_EQUAL_COS = 1e-9


@dataclass(frozen=True)
class MeshDistances:
    signed: np.ndarray  # (N,) [m]: NaN for points that are not finite
    nearest: np.ndarray  # (N, 3) [m]: the nearest point of the mesh
    slope_deg: np.ndarray  # (N,) [deg]: slope of the nearest triangle; NaN for points that are not finite
    num_degenerate: int  # Triangles without area, which were left out


def distance_to_mesh(
    points: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    sign: Sign = "up",
    advance: Callable[[int], object] | None = None,
) -> MeshDistances:
    """Signed distance of points (N, 3) [m] to the nearest point of a mesh, or of its rim, in one frame, z up.

    Parameters
    ----------
    sign : {"up", "winding"}
        ``"up"``: positive above. Triangles whose normal points down (n_z below -0.05) are reversed first,
        the winding is kept where |n_z| is at most 0.05. ``"winding"``: positive on the side from which the
        corners run counter-clockwise, as CloudCompare signs.
    advance : callable, optional
        Called with the number of points that were finished since the last call.

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
    slope = np.full(len(points), np.nan)
    finite = np.flatnonzero(np.isfinite(points).all(axis=1))
    order = finite[_in_strips(points[finite])]
    parts = [order[start : start + _CHUNK] for start in range(0, len(order), _CHUNK)]
    with ThreadPoolExecutor(_WORKERS) as pool:
        for rows, found in zip(
            parts, pool.map(lambda rows: surface.measure(points[rows] - origin), parts), strict=True
        ):
            signed[rows], nearest[rows], slope[rows] = found
            if advance is not None:
                advance(len(rows))
    return MeshDistances(signed, nearest + origin, slope, int((~sound).sum()))


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
        self._slope_deg = slope_deg(normals)
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)
        # Triangles around vertex v: star_faces[star_start[v] : star_start[v + 1]].
        corners = self._faces.ravel()
        self._star_faces = np.argsort(corners, kind="stable") // 3
        self._star_start = np.concatenate([[0], np.cumsum(np.bincount(corners, minlength=len(vertices)))])

    def measure(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Signed distances (N,), nearest points (N, 3) and the slopes there (N,) [deg]."""
        _, hit, nearest = self._tree.squared_distance(self._vertices, self._faces, points)
        # igl squeezes a single row.
        hit, nearest = np.reshape(hit, len(points)), np.reshape(nearest, points.shape)
        direction = points - nearest
        distance = np.linalg.norm(direction, axis=1)
        direction /= np.where(distance > 0.0, distance, 1.0)[:, None]
        positive = np.einsum("ij,ij->i", direction, self._normals[hit]) >= 0.0
        corners = self._vertices[self._faces[hit]]
        weights = np.reshape(igl.barycentric_coordinates(nearest, *np.moveaxis(corners, 1, 0)), points.shape)
        tied = np.flatnonzero((weights.min(axis=1) < _ON_EDGE) & (distance > 0.0))
        # The vertices with most weight: of an edge both, of a vertex the same twice.
        order = np.argsort(-weights[tied], axis=1)[:, :2]
        second = np.take_along_axis(weights[tied], order, axis=1)[:, 1]
        order[:, 1] = np.where(second < _ON_EDGE, order[:, 0], order[:, 1])
        feature = np.take_along_axis(self._faces[hit[tied]], order, axis=1)
        for part, counts in self._blocks(feature[:, 0]):
            positive[tied[part]] = self._is_above(direction[tied[part]], feature[part], counts)
        return np.where(positive, distance, -distance), nearest, self._slope_deg[hit]

    def _blocks(self, vertex: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Rows of vertices (N,) in blocks of bounded work, each with the sizes of their stars (triangles around)."""
        counts = self._star_start[vertex + 1] - self._star_start[vertex]
        block = np.cumsum(counts) // _PAIR_CHUNK
        cuts = np.flatnonzero(np.diff(block)) + 1
        return (
            zip(np.split(np.arange(len(vertex)), cuts), np.split(counts, cuts), strict=True)
            if len(vertex)
            else iter(())
        )

    def _is_above(self, direction: np.ndarray, feature: np.ndarray, counts: np.ndarray) -> np.ndarray:
        """Whether points (N,) in a direction from their nearest point, on an edge or vertex, lie above the surface."""
        starts = np.cumsum(counts) - counts
        point = np.repeat(np.arange(len(feature)), counts)
        within = np.arange(counts.sum()) - starts[point]
        face = self._star_faces[self._star_start[feature[point, 0]] + within]
        cos = np.einsum("ij,ij->i", direction[point], self._normals[face])
        # Around an edge only the triangles that have its other vertex too.
        shares = (self._faces[face] == feature[point, 1, None]).any(axis=1)
        orthogonality = np.where(shares, np.abs(cos), -1.0)
        most = np.maximum.reduceat(orthogonality, starts)
        chosen = orthogonality >= most[point] - _EQUAL_COS
        return np.logical_or.reduceat(chosen & (cos >= 0.0), starts)


def _in_strips(points: np.ndarray) -> np.ndarray:
    """Order (N,) of points along strips of the plan: the tree finds its boxes in the cache, six times faster."""
    plan = points[:, :2]
    low, high = (plan.min(axis=0), plan.max(axis=0)) if len(plan) else (0.0, 0.0)
    column, row = ((plan - low) / np.where(high > low, (high - low) / 65535.0, 1.0)).astype(np.uint16).T
    # numpy sorts 16-bit integers by radix sort, ten times as fast as 32-bit ones by comparison.
    return np.lexsort((column, row >> 8))


def sample_mesh(
    vertices: np.ndarray, faces: np.ndarray, num_samples: int = NUM_SAMPLES, *, seed: int = SEED
) -> tuple[np.ndarray, np.ndarray]:
    """Points (num_samples, 3) [m] spread independently and uniformly by area over a mesh, and the face (num_samples,)
    of each, in the order of the faces.

    Vertices (V, 3) [m] are in a Cartesian frame: in a map grid areas would be distorted.
    """
    areas = np.linalg.norm(area_vectors(vertices, faces), axis=1)
    cumulative = np.cumsum(areas)
    if not len(areas) or not cumulative[-1] > 0.0:
        raise ValueError(f"the {len(areas)} triangles have no area to sample, expected a surface")
    rng = np.random.default_rng(seed)
    at = np.sort(rng.random(num_samples)) * cumulative[-1]
    face = np.searchsorted(cumulative, at, side="right").clip(max=np.flatnonzero(areas)[-1])
    # Uniform in a triangle: the square root makes the density along the first coordinate that of its width.
    root, along = np.sqrt(rng.random(num_samples)), rng.random(num_samples)
    weights = np.stack([1.0 - root, root * (1.0 - along), root * along], axis=1)
    return np.einsum("nk,nkd->nd", weights, vertices[faces[face]]), face


def distance_to_cloud(
    points: np.ndarray, cloud: np.ndarray, *, within_m: float = math.inf
) -> tuple[np.ndarray, np.ndarray]:
    """Distance (N,) [m] from points (N, 3) to the nearest point of a cloud (M, 3), and its number (N,).

    Beyond ``within_m`` the search is not finished: there, and where the cloud is empty, the distance is
    infinite and the number -1. NaN and -1 for points that are not finite.
    """
    distances = np.where(np.isfinite(points).all(axis=1), np.inf, np.nan)
    numbers = np.full(len(points), -1, dtype=np.int64)
    # Many equal points would form a leaf that cannot be split and slows every query near it.
    first, _ = distinct(cloud)
    first = first[np.isfinite(cloud[first]).all(axis=1)]
    rows = np.flatnonzero(distances == np.inf)
    if not len(first) or not len(rows):
        return distances, numbers
    tree = cKDTree(cloud[first], balanced_tree=False, compact_nodes=False)
    found, at = tree.query(points[rows], distance_upper_bound=within_m * (1.0 + _SEARCH_MARGIN), workers=-1)
    is_found = at < len(first)
    distances[rows[is_found]] = found[is_found]
    numbers[rows[is_found]] = first[at[is_found]]
    return distances, numbers


def is_reached(samples: np.ndarray, cloud: np.ndarray, *, tolerance_m: float) -> np.ndarray:
    """Whether each sample (N,) of a reference is strictly closer to the cloud than the tolerance.

    The mean is the completeness of S. Seitz et al., A comparison and evaluation of multi-view stereo
    reconstruction algorithms, CVPR 2006.
    """
    distances, _ = distance_to_cloud(samples, cloud, within_m=tolerance_m)
    return distances < tolerance_m


def f_score(accuracy_share: float, completeness: float) -> float:
    """Harmonic mean of the share of the cloud near the reference and that of the reference near the cloud."""
    total = accuracy_share + completeness
    return 2.0 * accuracy_share * completeness / total if total > 0.0 else 0.0


def is_outlier(points: np.ndarray, *, neighbours: int, num_std: float) -> np.ndarray:
    """Statistical outliers (N,) of points (N, 3) [m]: far above the average from so many nearest neighbours.

    A point is one where its mean distance to them exceeds the mean of all by more than ``num_std`` of their standard
    deviations (of a population), as the filter "SOR" of CloudCompare has it (R. B. Rusu et al., Towards 3D point cloud
    based object maps for household environments, Robotics and Autonomous Systems 56, 2008, section 4.1).
    """
    if len(points) < 2:
        return np.zeros(len(points), dtype=bool)
    count = min(neighbours, len(points) - 1)
    # The nearest of all is the point itself.
    distances, _ = cKDTree(points, balanced_tree=False, compact_nodes=False).query(points, k=count + 1, workers=-1)
    mean = distances[:, 1:].mean(axis=1)
    return mean > mean.mean() + num_std * mean.std()
